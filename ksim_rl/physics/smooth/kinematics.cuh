// Part 1: kinematics (mj_kinematics). A chain from a root to a leaf is one lane's, whatever chains share: it passes the
// pose on from body to body in registers, and lanes that compute the same body find and write the same.
#pragma once
#include "ksim_rl/physics/smooth/shared_memory.cuh"

namespace smooth_dynamics {

CUDA_CALLABLE inline int first_link(const Arguments& a, int chain)
{
    return look_up(a.body_branch_start, chain);
}

CUDA_CALLABLE inline void place_bodies(const World& world, const Arguments& a, const SharedMemory& shared)
{
    const float* const qpos = world.row_of(a.qpos);
    const float* const qpos0 = world.model_row(a.qpos0);
    if (world.lane == 0) {
        shared.position(0) = vec3();
        shared.turn(0) = quat(1.0f, 0.0f, 0.0f, 0.0f);
    }
    // By how much a joint turns, or a slide shifts, is found by a lane for each joint, before chains wait for one another.
    world.each(NUM_JOINTS, [&](int joint) {
        const int type = look_up(a.jnt_type, joint), address = look_up(a.jnt_qposadr, joint);
        if (type == BALL || type == FREE) {
            shared.turned_by(joint) = unit_quat(qpos + address + (type == FREE ? 3 : 0));
            return;
        }
        const float shift = qpos[address] - qpos0[address], half = 0.5f * shift, sine = wp::sin(half);
        const vec3 own_axis = world.model_row(a.jnt_axis)[joint];
        shared.turned_by(joint) = type == SLIDE
            ? quat(shift, 0.0f, 0.0f, 0.0f)
            : quat(wp::cos(half), sine * own_axis[0], sine * own_axis[1], sine * own_axis[2]);
    });
    sync_warp();
    world.each(NUM_CHAINS, [&](int chain) {
        vec3 pos;
        quat rot(1.0f, 0.0f, 0.0f, 0.0f);
#pragma unroll 1
        for (int link = first_link(a, chain); link < first_link(a, chain + 1); ++link) {
            const int body = look_up(a.body_branches, link);
            const int first = look_up(a.body_jntadr, body), count = look_up(a.body_jntnum, body);
            if (count == 1 && look_up(a.jnt_type, first) == FREE) {
                const float* const q = qpos + look_up(a.jnt_qposadr, first);
                pos = vec3(q[0], q[1], q[2]);
                rot = shared.turned_by(first);
                shared.anchor(first) = pos;
                shared.axis(first) = world.model_row(a.jnt_axis)[first];
            } else {
                vec3 from_parent = world.model_row(a.body_pos)[body];
                quat turn_of_parent = world.model_row(a.body_quat)[body];
                const int mocap = HAS_MOCAP ? look_up(a.body_mocapid, body) : -1;
                if (mocap >= 0) {
                    from_parent = world.row_of(a.mocap_pos)[mocap];
                    turn_of_parent = world.row_of(a.mocap_quat)[mocap];
                }
                pos = pos + rotate(from_parent, rot);
                rot = product(rot, turn_of_parent);
#pragma unroll 1
                for (int joint = first; joint < first + count; ++joint) {
                    const vec3 own_anchor = world.model_row(a.jnt_pos)[joint];
                    shared.anchor(joint) = pos + rotate(own_anchor, rot);
                    shared.axis(joint) = rotate(world.model_row(a.jnt_axis)[joint], rot);
                    if (look_up(a.jnt_type, joint) == SLIDE) {
                        pos = pos + shared.axis(joint) * shared.turned_by(joint).x;
                        continue;
                    }
                    rot = product(rot, shared.turned_by(joint));
                    // The anchor stays in its place.
                    pos = shared.anchor(joint) - rotate(own_anchor, rot);
                }
                rot = wp::normalize(rot);
            }
            shared.position(body) = pos;
            shared.turn(body) = rot;
        }
    });
    sync_warp();
}

// Geoms of the world stay where make_data, or fixed_geoms.py, has put them.
CUDA_CALLABLE inline void place_geoms(const World& world, const Arguments& a, const SharedMemory& shared)
{
    auto geom_of = [&](int item) { return look_up(a.moving_geoms, item); };
    compute_row(world, shared, a.geom_xpos, NUM_MOVING_GEOMS, geom_of, [&](int item) {
        const int geom = geom_of(item), body = look_up(a.geom_bodyid, geom);
        return shared.position(body) + rotate(world.model_row(a.geom_pos)[geom], shared.turn(body));
    });
    compute_row(world, shared, a.geom_xmat, NUM_MOVING_GEOMS, geom_of, [&](int item) {
        const int geom = geom_of(item), body = look_up(a.geom_bodyid, geom);
        return matrix(product(shared.turn(body), world.model_row(a.geom_quat)[geom]));
    });
    if (a.empties_pool && world.world == 0 && world.lane == 0)
        *a.nacon.data = 0;
}

CUDA_CALLABLE inline mat33 inertial_frame(const World& world, const Arguments& a, const SharedMemory& shared, int body)
{
    return matrix(product(shared.turn(body), world.model_row(a.body_iquat)[body]));
}

// Centres of mass, and poses that are read.
CUDA_CALLABLE inline void write_poses(const World& world, const Arguments& a, const SharedMemory& shared)
{
    world.each(NUM_BODIES, [&](int body) {
        shared.center(body) = shared.position(body) + rotate(world.model_row(a.body_ipos)[body], shared.turn(body));
    });
    sync_warp();
    write(world, a.xipos, NUM_BODIES, shared.poses + 7, POSE);
    if (a.is_read) {
        write(world, a.xpos, NUM_BODIES, shared.poses, POSE);
        write(world, a.xquat, NUM_BODIES, shared.poses + 3, POSE);
        write(world, a.xanchor, NUM_JOINTS, shared.joints, 6);
        write(world, a.xaxis, NUM_JOINTS, shared.joints + 3, 6);
        auto itself = [](int item) { return item; };
        auto frame_of = [&](int body) { return matrix(shared.turn(body)); };
        auto inertial_frame_of = [&](int body) { return inertial_frame(world, a, shared, body); };
        compute_row(world, shared, a.xmat, NUM_BODIES, itself, frame_of);
        compute_row(world, shared, a.ximat, NUM_BODIES, itself, inertial_frame_of);
        compute_row(world, shared, a.site_xpos, NUM_SITES, itself, [&](int site) {
            const int body = look_up(a.site_bodyid, site);
            return shared.position(body) + rotate(world.model_row(a.site_pos)[site], shared.turn(body));
        });
        compute_row(world, shared, a.site_xmat, NUM_SITES, itself, [&](int site) {
            return matrix(product(shared.turn(look_up(a.site_bodyid, site)), world.model_row(a.site_quat)[site]));
        });
    }
}

}
