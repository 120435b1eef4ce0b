// Part 5 of the integration: the state at the end of the substep (mj_advance), and which rows and contacts found no
// room.

each(NUM_DOFS, [&](int dof) {
    row_of(problem.qvel)[dof] = right[dof] = row_of(problem.qvel)[dof] + timestep * qacc[dof];
    row_of(problem.qacc_warmstart)[dof] = row_of(problem.qacc)[dof];
});
if (ACTUATORS_ACT)
    each(NUM_ACTUATORS, [&](int actuator) {
        const int address = activation_of(actuator);
        if (address >= 0 && !is_switched_off(actuator))
            row_of(problem.act)[address] = next_activation(actuator, address, row_of(problem.act_dot)[address]);
    });
sync();
each(NUM_JOINTS, [&](int joint) {
    const int type = look_up(problem.jnt_type, joint);
    const float* v = right + look_up(problem.jnt_dofadr, joint);
    float* q = row_of(problem.qpos) + look_up(problem.jnt_qposadr, joint);
    if (type == HINGE || type == SLIDE) {
        q[0] += timestep * v[0];
        return;
    }
    if (type == FREE) {
        for (int i = 0; i < 3; ++i)
            q[i] += timestep * v[i];
        q += 3;
        v += 3;
    }
    const vec3 spin(v[0], v[1], v[2]), axis = wp::normalize(spin);
    const float half = 0.5f * timestep * wp::length(spin), sine = wp::sin(half);
    const quat by(wp::cos(half), sine * axis[0], sine * axis[1], sine * axis[2]);
    const quat reached = wp::normalize(product(unit_quat(q), by));
    q[0] = reached.x;
    q[1] = reached.y;
    q[2] = reached.z;
    q[3] = reached.w;
});
if (lane == 0) {
    problem.time.data[world] += timestep;
    const bool lacks_rows = problem.nefc.data[world] > problem.njmax;
    const bool lacks_pairs = problem.ncollision.data[0] > problem.naconmax;
    const bool lacks_contacts = problem.nacon.data[0] > problem.naconmax;
    problem.overflow.data[world] |= (lacks_rows ? OUT_OF_ROWS : 0) | (lacks_pairs ? OUT_OF_PAIRS : 0)
        | (lacks_contacts ? OUT_OF_CONTACTS : 0);
}
