// What accelerometers read: the acceleration of their body (mj_rnePostConstraint), summed from its root on, at their place.

each(problem.accelerates ? ACCELEROMETERS : 0, [&](int place) {
    const int sensor = problem.sensors.data[SENSORS + place], site = problem.sensor_objid.data[sensor];
    const int body = problem.site_bodyid.data[site];
    const int* const moves = problem.body_isdofancestor.data + (size_t)body * problem.body_isdofancestor.shape[1];
    wp::vec_t<6, float> rising(0.0f);
    for (int axis = 0; axis < 3; ++axis)
        rising[3 + axis] = GRAVITY ? -problem.gravity.data[problem.gravity.shape[0] > 1 ? world : 0][axis] : 0.0f;
    // All are read, also those that do not move it, so that several are on their way at once.
#pragma unroll 5
    for (int dof = 0; dof < NUM_DOFS; ++dof) {
        const auto carried = rising + row_of(problem.cdof_dot)[dof] * row_of(problem.qvel)[dof];
        const auto moved = carried + row_of(problem.cdof)[dof] * row_of(problem.qacc)[dof];
        rising = moves[dof] ? moved : rising;
    }
    const auto& moving = row_of(problem.cvel)[body];
    const wp::mat33 back = wp::transpose(row_of(problem.site_xmat)[site]);
    const vec3 arm = row_of(problem.site_xpos)[site] - row_of(problem.subtree_com)[problem.body_rootid.data[body]];
    auto at_site = [&](const auto& v) {
        return wp::mul(back, vec3(v[3], v[4], v[5]) - wp::cross(arm, vec3(v[0], v[1], v[2])));
    };
    const vec3 spin = wp::mul(back, vec3(moving[0], moving[1], moving[2]));
    const vec3 read = at_site(rising) + wp::cross(spin, at_site(moving));
    for (int axis = 0; axis < 3; ++axis)
        row_of(problem.sensordata)[problem.sensor_adr.data[sensor] + axis] = read[axis];
});
