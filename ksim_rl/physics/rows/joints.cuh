// The rows of joints: those tied by equalities, then dry friction, then limits.
#pragma once
#include "ksim_rl/physics/rows/row.cuh"

namespace constraint_rows {

// "Equality": q1 = q1_0 + polynomial(q2 - q2_0), of one joint or two.
CUDA_CALLABLE inline void tie_joints(Rows& rows)
{
    const World& world = rows.world;
    const Arguments& a = rows.a;
    in_turns(world, EQUALITIES, [&](int item, bool exists) {
        const int equality = exists ? a.eq_jnt_adr.data[item] : 0;
        exists = exists && world.row_of(a.eq_active)[equality];
        const int joint = exists ? a.eq_obj1id.data[equality] : 0;
        const int other = exists ? a.eq_obj2id.data[equality] : -1;
        const Place place = rows.reserve(exists, other >= 0 ? 2 : 1);
        if (place.rows == 0)
            return;
        const auto& poly = world.model_row(a.eq_data)[equality];
        auto away = [&](int of) {
            const int at = a.jnt_qposadr.data[of];
            return rows.qpos[at] - world.model_row(a.qpos0)[at];
        };
        const int dof = a.jnt_dofadr.data[joint];
        Row row = {EQUALITY, equality, away(joint) - poly[0], 0.0f, rows.qvel[dof], world.model_row(a.dof_invweight0)[dof]};
        row.softness = 1.0f;
        rows.write_nonzero(place.address, dof, 1.0f);
        if (other >= 0) {
            const int other_dof = a.jnt_dofadr.data[other];
            const float x = away(other);
            const float slope = poly[1] + x * (2.0f * poly[2] + x * (3.0f * poly[3] + x * 4.0f * poly[4]));
            row.position = away(joint) - (poly[0] + x * (poly[1] + x * (poly[2] + x * (poly[3] + x * poly[4]))));
            row.velocity -= rows.qvel[other_dof] * slope;
            row.invweight += world.model_row(a.dof_invweight0)[other_dof];
            rows.write_nonzero(place.address + 1, other_dof, -slope);
        }
        world.row_of(a.efc_J_rownnz)[place.row] = other >= 0 ? 2 : 1;
        world.row_of(a.efc_J_rowadr)[place.row] = place.address;
        const Law law = rows.law_of(
            world.model_row(a.eq_solref)[equality], world.model_row(a.eq_solimp)[equality], row.position
        );
        rows.write_row(place.row, row, law);
    });
}

// "Friction loss": of a damper alone, whose force is bounded.
CUDA_CALLABLE inline void slow_joints(Rows& rows)
{
    const World& world = rows.world;
    const Arguments& a = rows.a;
    in_turns(world, FRICTIONLOSS ? NUM_DOFS : 0, [&](int dof, bool exists) {
        const float loss = exists ? world.model_row(a.dof_frictionloss)[dof] : 0.0f;
        const Place place = rows.reserve(loss > 0.0f, 1);
        if (place.rows == 0)
            return;
        Law law = rows.law_of(world.model_row(a.dof_solref)[dof], world.model_row(a.dof_solimp)[dof], 0.0f);
        law.stiffness = 0.0f;
        rows.write_nonzero(place.address, dof, 1.0f);
        world.row_of(a.efc_J_rownnz)[place.row] = 1;
        world.row_of(a.efc_J_rowadr)[place.row] = place.address;
        const float invweight = world.model_row(a.dof_invweight0)[dof];
        rows.write_row(place.row, {FRICTION_DOF, dof, 0.0f, 0.0f, rows.qvel[dof], invweight, loss, 1.0f}, law);
    });
}

// "Limit": of a slide or hinge each of its two, of which both hold where the range is narrower than their margins; of a
// ball the angle by which it is turned.
CUDA_CALLABLE inline void limit_joints(Rows& rows)
{
    const World& world = rows.world;
    const Arguments& a = rows.a;
    in_turns(world, LIMITED_JOINTS, [&](int item, bool exists) {
        const int joint = exists ? a.limited.data[item] : 0;
        const bool ball = exists && a.jnt_type.data[joint] == BALL;
        float lower = 0.0f, upper = 0.0f;  // distances of the bounds; a ball has one
        vec3 axis;
        if (exists) {
            const auto& range = world.model_row(a.jnt_range)[joint];
            const float margin = world.model_row(a.jnt_margin)[joint];
            const float* const q = rows.qpos + a.jnt_qposadr.data[joint];
            if (ball) {
                const quat turn = wp::normalize(quat(q[0], q[1], q[2], q[3]));  // w x y z
                axis = vec3(turn.y, turn.z, turn.w);
                const float sine = wp::length(axis);
                float angle = 2.0f * wp::atan2(sine, turn.x);
                angle -= angle > PI ? 2.0f * PI : 0.0f;
                axis = sine > 0.0f ? axis * angle / sine : vec3();
                angle = wp::length(axis);
                axis = angle > 0.0f ? axis / angle : axis;
                lower = wp::max(range[0], range[1]) - angle - margin;
            } else {
                lower = q[0] - range[0] - margin;
                upper = range[1] - q[0] - margin;
            }
        }
        const Place place = rows.reserve((lower < 0.0f) + (upper < 0.0f), ball ? 3 : 1);
        if (place.rows == 0)
            return;
        const int dof = a.jnt_dofadr.data[joint];
        const float margin = world.model_row(a.jnt_margin)[joint], invweight = world.model_row(a.dof_invweight0)[dof];
#pragma unroll 1
        for (int i = 0; i < (BOTH_LIMITS ? place.rows : 1); ++i) {
            const bool is_lower = lower < 0.0f && i == 0;
            const float distance = is_lower ? lower : upper, sign = is_lower ? 1.0f : -1.0f;
            const int row = place.row + i, address = place.address + i;
            float velocity = sign * rows.qvel[dof];
            if (ball) {
                velocity = -axis[0] * rows.qvel[dof];
                velocity -= axis[1] * rows.qvel[dof + 1];
                velocity -= axis[2] * rows.qvel[dof + 2];
            }
            for (int part = 0; part < (ball ? 3 : 1); ++part)
                rows.write_nonzero(address + part, dof + part, ball ? -axis[part] : sign);
            world.row_of(a.efc_J_rownnz)[row] = ball ? 3 : 1;
            world.row_of(a.efc_J_rowadr)[row] = address;
            const Law law = rows.law_of(world.model_row(a.jnt_solref)[joint], world.model_row(a.jnt_solimp)[joint], distance);
            rows.write_row(row, {LIMIT_JOINT, joint, distance, margin, velocity, invweight, 0.0f, 1.0f}, law);
        }
    });
}

}
