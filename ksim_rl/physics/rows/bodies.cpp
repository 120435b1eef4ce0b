// What the contacts of each body exert on it, in their order, added to what users apply at its center of mass.

each(BODIES, [&](int body) {
    auto total = row_of(problem.xfrc_applied)[body];
    for (int i = 0; i < contacts; ++i) {
        const int contact = listed[i];
        const auto& geoms = problem.contact_geom.data[contact];
        const int sign = (problem.geom_bodyid.data[geoms[1]] == body) - (problem.geom_bodyid.data[geoms[0]] == body);
        if (!sign)
            continue;
        const Wrench wrench = wrench_of(contact);
        const vec3 force = (float)sign * in_world(contact, wrench.force);
        const vec3 arm = problem.contact_pos.data[contact] - row_of(problem.xipos)[body];
        const vec3 torque = (float)sign * in_world(contact, wrench.torque) + wp::cross(arm, force);
        for (int axis = 0; axis < 3; ++axis) {
            total[axis] += force[axis];
            total[3 + axis] += torque[axis];
        }
    }
    row_of(problem.forces)[body] = total;
});
