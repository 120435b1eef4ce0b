// Part 4: velocities (mj_comVel), bias forces (mj_rne without accelerations) and the inertia matrix (mj_crb). A body
// accelerates with the one before it and by the rates of the axes that its own velocity turns; gravity is an
// acceleration of the world.

const float* const qvel = row_of(problem.qvel);
const spatial from_gravity = spatial_of(vec3(), GRAVITY ? -of_world(problem.gravity) : vec3());

if (lane == 0) {
    velocity(0) = spatial();
    force(0) = from_gravity;
}
each(NUM_CHAINS, [&](int chain) {
    spatial moving, rising = from_gravity;
#pragma unroll 1
    for (int link = chain_begin[chain]; link < chain_begin[chain + 1]; ++link) {
        const int body = chains[link], first = problem.body_jntadr.data[body];
        int dof = problem.body_dofadr.data[body];
#pragma unroll 1
        for (int joint = first; joint < first + problem.body_jntnum.data[body]; ++joint) {
            const int type = problem.jnt_type.data[joint];
            // A free joint's first three axes are those of the world, which nothing turns.
            if (type == FREE)
                for (const int end = dof + 3; dof < end; ++dof) {
                    row_of(problem.cdof_dot)[dof] = spatial();
                    moving = moving + motion(dof) * qvel[dof];
                }
            // The axes of a ball turn together, with the velocity before all three.
            const int count = type == FREE || type == BALL ? 3 : 1;
            const spatial before = moving;
            for (const int end = dof + count; dof < end; ++dof) {
                const spatial rate = cross_motion(before, motion(dof));
                row_of(problem.cdof_dot)[dof] = rate;
                rising = rising + rate * qvel[dof];
                moving = moving + motion(dof) * qvel[dof];
            }
        }
        velocity(body) = moving;
        force(body) = rising;
    }
});
sync();
write(problem.cvel, NUM_BODIES, velocities, 6);
write(problem.cacc, NUM_BODIES, forces, 6);
sync();
each(NUM_BODIES, [&](int body) {
    const spatial pushed = times_inertia(inertia(body), force(body));
    const spatial turned = cross_force(velocity(body), times_inertia(inertia(body), velocity(body)));
    force(body) = body == 0 ? spatial() : pushed + turned;
});
sync();
// Inertias are not summed into the world's.
sum_subtrees(16, [&](int index) {
    return index < 10 ? Column {inertias + index, POSE, 1} : Column {forces + index - 10, 6, 0};
});
write(problem.cfrc_int, NUM_BODIES, forces, 6);

each(NUM_DOFS, [&](int dof) {
    momentum(dof) = times_inertia(inertia(problem.dof_bodyid.data[dof]), motion(dof));
});
sync();
// Calls body(actuator) for the actuators that add armature or damping to a joint: none, one, or (below -1) several.
auto each_actuator_of = [&](int joint, auto body) {
    const int only = problem.jnt_actuatorid.data[joint];
    if (only >= 0)
        body(only);
    for (int actuator = 0; only < -1 && actuator < NUM_ACTUATORS; ++actuator) {
        const int type = problem.actuator_trntype.data[actuator];
        if ((type == JOINT || type == JOINT_IN_PARENT) && problem.actuator_trnid.data[actuator][0] == joint)
            body(actuator);
    }
};
each(problem.M_hinit_i.shape[0], [&](int entry) {
    const int row = problem.M_hinit_i.data[entry], column = problem.M_colind.data[entry];
    float found = wp::dot(motion(column), momentum(row));
    if (row == column) {
        float armature = model_row(problem.dof_armature)[row];
        each_actuator_of(problem.dof_jntid.data[row], [&](int actuator) {
            const float gear = model_row(problem.actuator_gear)[actuator][0];
            armature += model_row(problem.actuator_armature)[actuator] * gear * gear;
        });
        found += armature;
    }
    row_of(problem.M)[entry] = found;
});
