// Part 3: kinematics (mj_kinematics). A chain from a root to a leaf is one lane's, whatever chains share: it passes the
// pose on from body to body in registers, and lanes that compute the same body find and write the same.

if (problem.masked && !problem.mask.data[world])
    return;
const float* const qpos = row_of(problem.qpos);
const float* const qpos0 = model_row(problem.qpos0);
auto first_link = [&](int chain) { return look_up(problem.body_branch_start, chain); };

if (lane == 0) {
    position(0) = vec3();
    turn(0) = quat(1.0f, 0.0f, 0.0f, 0.0f);
}
// By how much a joint turns, or a slide shifts, is found by a lane for each joint, before chains wait for one another.
auto turned_by = [&](int joint) -> quat& { return *(quat*)(staged + 4 * joint); };
each(NUM_JOINTS, [&](int joint) {
    const int type = look_up(problem.jnt_type, joint), address = look_up(problem.jnt_qposadr, joint);
    if (type == BALL || type == FREE) {
        turned_by(joint) = unit_quat(qpos + address + (type == FREE ? 3 : 0));
        return;
    }
    const float shift = qpos[address] - qpos0[address], half = 0.5f * shift, sine = wp::sin(half);
    const vec3 own_axis = model_row(problem.jnt_axis)[joint];
    turned_by(joint) = type == SLIDE
        ? quat(shift, 0.0f, 0.0f, 0.0f)
        : quat(wp::cos(half), sine * own_axis[0], sine * own_axis[1], sine * own_axis[2]);
});
sync();
each(NUM_CHAINS, [&](int chain) {
    vec3 pos;
    quat rot(1.0f, 0.0f, 0.0f, 0.0f);
#pragma unroll 1
    for (int link = first_link(chain); link < first_link(chain + 1); ++link) {
        const int body = look_up(problem.body_branches, link);
        const int first = look_up(problem.body_jntadr, body), count = look_up(problem.body_jntnum, body);
        if (count == 1 && look_up(problem.jnt_type, first) == FREE) {
            const float* const q = qpos + look_up(problem.jnt_qposadr, first);
            pos = vec3(q[0], q[1], q[2]);
            rot = turned_by(first);
            anchor(first) = pos;
            axis(first) = model_row(problem.jnt_axis)[first];
        } else {
            vec3 from_parent = model_row(problem.body_pos)[body];
            quat turn_of_parent = model_row(problem.body_quat)[body];
            const int mocap = HAS_MOCAP ? look_up(problem.body_mocapid, body) : -1;
            if (mocap >= 0) {
                from_parent = row_of(problem.mocap_pos)[mocap];
                turn_of_parent = row_of(problem.mocap_quat)[mocap];
            }
            pos = pos + rotate(from_parent, rot);
            rot = product(rot, turn_of_parent);
#pragma unroll 1
            for (int joint = first; joint < first + count; ++joint) {
                const vec3 own_anchor = model_row(problem.jnt_pos)[joint];
                anchor(joint) = pos + rotate(own_anchor, rot);
                axis(joint) = rotate(model_row(problem.jnt_axis)[joint], rot);
                if (look_up(problem.jnt_type, joint) == SLIDE) {
                    pos = pos + axis(joint) * turned_by(joint).x;
                    continue;
                }
                rot = product(rot, turned_by(joint));
                // The anchor stays in its place.
                pos = anchor(joint) - rotate(own_anchor, rot);
            }
            rot = wp::normalize(rot);
        }
        position(body) = pos;
        turn(body) = rot;
    }
});
sync();
// Geoms of the world stay where make_data, or fixed_geoms.py, has put them.
auto geom_of = [&](int item) { return look_up(problem.moving_geoms, item); };
if (problem.places_geoms) {
    compute_row(problem.geom_xpos, NUM_MOVING_GEOMS, geom_of, [&](int item) {
        const int geom = geom_of(item), body = look_up(problem.geom_bodyid, geom);
        return position(body) + rotate(model_row(problem.geom_pos)[geom], turn(body));
    });
    compute_row(problem.geom_xmat, NUM_MOVING_GEOMS, geom_of, [&](int item) {
        const int geom = geom_of(item), body = look_up(problem.geom_bodyid, geom);
        return matrix(product(turn(body), model_row(problem.geom_quat)[geom]));
    });
    if (problem.empties_pool && world == 0 && lane == 0)
        *problem.nacon.data = 0;
}
if (!problem.goes_on)
    return;
each(NUM_BODIES, [&](int body) {
    center(body) = position(body) + rotate(model_row(problem.body_ipos)[body], turn(body));
});
sync();
auto inertial_frame = [&](int body) {
    return matrix(product(turn(body), model_row(problem.body_iquat)[body]));
};
write(problem.xipos, NUM_BODIES, poses + 7, POSE);
if (problem.is_read) {
    write(problem.xpos, NUM_BODIES, poses, POSE);
    write(problem.xquat, NUM_BODIES, poses + 3, POSE);
    write(problem.xanchor, NUM_JOINTS, joints, 6);
    write(problem.xaxis, NUM_JOINTS, joints + 3, 6);
    compute_row(problem.xmat, NUM_BODIES, itself, [&](int body) { return matrix(turn(body)); });
    compute_row(problem.ximat, NUM_BODIES, itself, inertial_frame);
    compute_row(problem.site_xpos, NUM_SITES, itself, [&](int site) {
        const int body = look_up(problem.site_bodyid, site);
        return position(body) + rotate(model_row(problem.site_pos)[site], turn(body));
    });
    compute_row(problem.site_xmat, NUM_SITES, itself, [&](int site) {
        return matrix(product(turn(look_up(problem.site_bodyid, site)), model_row(problem.site_quat)[site]));
    });
}
