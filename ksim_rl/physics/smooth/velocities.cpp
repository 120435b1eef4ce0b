// Part 5: velocities (mj_comVel), bias forces (mj_rne without accelerations) and the inertia matrix (mj_crb). A body
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
    for (int link = first_link(chain); link < first_link(chain + 1); ++link) {
        const int body = look_up(problem.body_branches, link), first = look_up(problem.body_jntadr, body);
        int dof = look_up(problem.body_dofadr, body);
#pragma unroll 1
        for (int joint = first; joint < first + look_up(problem.body_jntnum, body); ++joint) {
            const int type = look_up(problem.jnt_type, joint);
            // A free joint's first three axes are those of the world, which nothing turns.
            if (type == FREE)
                for (const int end = dof + 3; dof < end; ++dof) {
                    if (problem.is_read)
                        row_of(problem.cdof_dot)[dof] = spatial();
                    moving = moving + motion(dof) * qvel[dof];
                }
            // The axes of a ball turn together, with the velocity before all three.
            const int count = type == FREE || type == BALL ? 3 : 1;
            const spatial before = moving;
            for (const int end = dof + count; dof < end; ++dof) {
                const spatial rate = cross_motion(before, motion(dof));
                if (problem.is_read)
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
if (problem.is_read)
    write(problem.cvel, NUM_BODIES, velocities, 6);
if (!problem.forces_too) {
    if (!problem.sums_momenta)
        return;
    // Velocities and angular momenta of subtrees (mj_subtreeVel): summed about the centre of mass of all bodies.
    each(NUM_BODIES, [&](int body) {
        const spatial own = times_inertia(inertia(body), velocity(body));
        const vec3 arm = com(look_up(problem.body_rootid, body)) - com(0), pushed = translation_of(own);
        force(body) = body == 0 ? spatial() : spatial_of(rotation_of(own) + wp::cross(arm, pushed), pushed);
    });
    sync();
    sum_subtrees(6, [&](int index) { return Column {forces + index, 6}; });
    each(NUM_BODIES, [&](int body) {
        const vec3 pushed = translation_of(force(body));
        row_of(problem.subtree_linvel)[body] = pushed / wp::max(TINY, model_row(problem.body_subtreemass)[body]);
        row_of(problem.subtree_angmom)[body] = rotation_of(force(body)) - wp::cross(com(body) - com(0), pushed);
    });
    return;
}
if (problem.is_read)
    write(problem.cacc, NUM_BODIES, forces, 6);
sync();
each(NUM_BODIES, [&](int body) {
    const spatial pushed = times_inertia(inertia(body), force(body));
    const spatial turned = cross_force(velocity(body), times_inertia(inertia(body), velocity(body)));
    force(body) = body == 0 ? spatial() : pushed + turned;
});
sync();
sum_subtrees(16, [&](int index) {
    return index < 10 ? Column {inertias + index, POSE} : Column {forces + index - 10, 6};
});
if (problem.is_read)
    write(problem.cfrc_int, NUM_BODIES, forces, 6);
if (NUM_FREE_BODIES > 0)
    write(problem.crb, NUM_BODIES, inertias, POSE);  // the integration reads it

each(NUM_DOFS, [&](int dof) {
    momentum(dof) = times_inertia(inertia(look_up(problem.dof_bodyid, dof)), motion(dof));
});
sync();
#pragma unroll 4
for (int entry = lane; entry < problem.M_hinit_i.shape[0]; entry += LANES) {
    const int row = look_up(problem.M_hinit_i, entry), column = look_up(problem.M_colind, entry);
    if (row != column)
        row_of(problem.M)[entry] = wp::dot(motion(column), momentum(row));
}
each(NUM_DOFS, [&](int dof) {
    float armature = model_row(problem.dof_armature)[dof];
    each_actuator_of(look_up(problem.dof_jntid, dof), [&](int actuator) {
        const float gear = model_row(problem.actuator_gear)[actuator][0];
        armature += model_row(problem.actuator_armature)[actuator] * gear * gear;
    });
    const int entry = look_up(problem.M_rowadr, dof) + look_up(problem.M_rownnz, dof) - 1;
    row_of(problem.M)[entry] = wp::dot(motion(dof), momentum(dof)) + armature;
});
