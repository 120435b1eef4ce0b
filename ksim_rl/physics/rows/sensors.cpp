// What contact sensors read: of equally strong contacts the first of the list counts, as in the C engine.

auto is_of = [=](int geom, int kind, int element) {
    if (kind == NOTHING || kind == GEOM)
        return kind == NOTHING || geom == element;
    int body = problem.geom_bodyid.data[geom];
    while (kind == SUBTREE && body > element)
        body = problem.body_parentid.data[body];
    return body == element;
};

each(SENSORS, [&](int place) {
    const int sensor = problem.sensors.data[place];
    const int kind = problem.sensor_objtype.data[sensor], element = problem.sensor_objid.data[sensor];
    const int other_kind = problem.sensor_reftype.data[sensor], other = problem.sensor_refid.data[sensor];
    const bool is_net = problem.sensor_intprm.data[sensor * problem.sensor_intprm.shape[1] + 1] == SUM;
    int found = 0, strongest = -1;
    float size = 0.0f, most = -1.0f, sign = 1.0f;
    vec3 force(0.0f), position(0.0f);
    for (int i = 0; i < contacts; ++i) {
        const int contact = listed[i];
        const auto& geoms = problem.contact_geom.data[contact];
        // In the direction of the contact, or against it.
        const bool along = is_of(geoms[0], kind, element) && is_of(geoms[1], other_kind, other);
        if (!along && !(is_of(geoms[1], kind, element) && is_of(geoms[0], other_kind, other)))
            continue;
        ++found;
        const vec3 own_force = wrench_of(contact).force;
        const float own_size = wp::dot(own_force, own_force), own_sign = along ? 1.0f : -1.0f;
        if (is_net) {
            const float weight = sqrtf(own_size);
            size += weight;
            position += weight * problem.contact_pos.data[contact];
            force += in_world(contact, own_sign * own_force);
        } else if (own_size > most) {
            // The axes of the contact are turned with it, all but the second tangent.
            most = own_size, sign = own_sign, strongest = contact;
            force = vec3(own_force[0], own_force[1], sign * own_force[2]);
            position = problem.contact_pos.data[contact];
        }
    }
    if (!found)
        return;
    if (is_net)
        position = position / wp::max(size, 1e-15f);
    float* const out = row_of(problem.sensordata) + problem.sensor_adr.data[sensor];
    out[0] = (float)found;
    for (int axis = 0; axis < 3; ++axis) {
        out[1 + axis] = force[axis];
        out[4 + axis] = position[axis];
        if (strongest >= 0)
            for (int of_contact = 0; of_contact < 2; ++of_contact)
                out[7 + 3 * of_contact + axis] = sign * axis_of(strongest, of_contact)[axis];
    }
});
