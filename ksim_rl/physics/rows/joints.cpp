// Part 4: the rows of joints: those tied by equalities, then dry friction, then limits.

// "Equality": q1 = q1_0 + polynomial(q2 - q2_0), of one joint or two.
in_turns(EQUALITIES, [&](int item, bool exists) {
    const int equality = exists ? problem.eq_jnt_adr.data[item] : 0;
    exists = exists && row_of(problem.eq_active)[equality];
    const int joint = exists ? problem.eq_obj1id.data[equality] : 0;
    const int other = exists ? problem.eq_obj2id.data[equality] : -1;
    const Place place = reserve(exists, other >= 0 ? 2 : 1);
    if (place.rows == 0)
        return;
    const auto& poly = model_row(problem.eq_data)[equality];
    auto away = [&](int of) {
        const int at = problem.jnt_qposadr.data[of];
        return qpos[at] - model_row(problem.qpos0)[at];
    };
    const int dof = problem.jnt_dofadr.data[joint];
    Row row = {EQUALITY, equality, away(joint) - poly[0], 0.0f, qvel[dof], model_row(problem.dof_invweight0)[dof]};
    row.softness = 1.0f;
    write_nonzero(place.address, dof, 1.0f);
    if (other >= 0) {
        const int other_dof = problem.jnt_dofadr.data[other];
        const float x = away(other);
        const float slope = poly[1] + x * (2.0f * poly[2] + x * (3.0f * poly[3] + x * 4.0f * poly[4]));
        row.position = away(joint) - (poly[0] + x * (poly[1] + x * (poly[2] + x * (poly[3] + x * poly[4]))));
        row.velocity -= qvel[other_dof] * slope;
        row.invweight += model_row(problem.dof_invweight0)[other_dof];
        write_nonzero(place.address + 1, other_dof, -slope);
    }
    row_of(problem.efc_J_rownnz)[place.row] = other >= 0 ? 2 : 1;
    row_of(problem.efc_J_rowadr)[place.row] = place.address;
    const Law law = law_of(
        model_row(problem.eq_solref)[equality], model_row(problem.eq_solimp)[equality], row.position
    );
    write_row(place.row, row, law);
});
const int equalities = rows_made;

// "Friction loss": of a damper alone, whose force is bounded.
in_turns(FRICTIONLOSS ? NUM_DOFS : 0, [&](int dof, bool exists) {
    const float loss = exists ? model_row(problem.dof_frictionloss)[dof] : 0.0f;
    const Place place = reserve(loss > 0.0f, 1);
    if (place.rows == 0)
        return;
    Law law = law_of(model_row(problem.dof_solref)[dof], model_row(problem.dof_solimp)[dof], 0.0f);
    law.stiffness = 0.0f;
    write_nonzero(place.address, dof, 1.0f);
    row_of(problem.efc_J_rownnz)[place.row] = 1;
    row_of(problem.efc_J_rowadr)[place.row] = place.address;
    const float invweight = model_row(problem.dof_invweight0)[dof];
    write_row(place.row, {FRICTION_DOF, dof, 0.0f, 0.0f, qvel[dof], invweight, loss, 1.0f}, law);
});
const int frictions = rows_made - equalities;

// "Limit": of a slide or hinge each of its two, of which both hold where the range is narrower than their margins; of a
// ball the angle by which it is turned.
in_turns(LIMITED_JOINTS, [&](int item, bool exists) {
    const int joint = exists ? problem.limited.data[item] : 0;
    const bool ball = exists && problem.jnt_type.data[joint] == BALL;
    float lower = 0.0f, upper = 0.0f;  // distances of the bounds; a ball has one
    vec3 axis;
    if (exists) {
        const auto& range = model_row(problem.jnt_range)[joint];
        const float margin = model_row(problem.jnt_margin)[joint];
        const float* const q = qpos + problem.jnt_qposadr.data[joint];
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
    const Place place = reserve((lower < 0.0f) + (upper < 0.0f), ball ? 3 : 1);
    if (place.rows == 0)
        return;
    const int dof = problem.jnt_dofadr.data[joint];
    const float margin = model_row(problem.jnt_margin)[joint], invweight = model_row(problem.dof_invweight0)[dof];
#pragma unroll 1
    for (int i = 0; i < (BOTH_LIMITS ? place.rows : 1); ++i) {
        const bool is_lower = lower < 0.0f && i == 0;
        const float distance = is_lower ? lower : upper, sign = is_lower ? 1.0f : -1.0f;
        const int row = place.row + i, address = place.address + i;
        float velocity = sign * qvel[dof];
        if (ball) {
            velocity = -axis[0] * qvel[dof];
            velocity -= axis[1] * qvel[dof + 1];
            velocity -= axis[2] * qvel[dof + 2];
        }
        for (int part = 0; part < (ball ? 3 : 1); ++part)
            write_nonzero(address + part, dof + part, ball ? -axis[part] : sign);
        row_of(problem.efc_J_rownnz)[row] = ball ? 3 : 1;
        row_of(problem.efc_J_rowadr)[row] = address;
        const Law law = law_of(model_row(problem.jnt_solref)[joint], model_row(problem.jnt_solimp)[joint], distance);
        write_row(row, {LIMIT_JOINT, joint, distance, margin, velocity, invweight, 0.0f, 1.0f}, law);
    }
});
const int limits = rows_made - equalities - frictions;
