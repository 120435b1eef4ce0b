// What contact sensors read: of equally strong contacts the first of the list counts, as in the C engine. Each lane reads
// one of the next contacts and passes it on to all, each of which asks whether its sensor matches it: a contact lies
// anywhere in the pool, and what to read of it follows from what is read before.

auto vector_of_lane = [=](const vec3& v, int source) {
    return vec3(of_lane(v[0], source), of_lane(v[1], source), of_lane(v[2], source));
};

#pragma unroll 1
for (int place = lane; place - lane < SENSORS; place += LANES) {
    const int sensor = problem.sensors.data[wp::min(place, SENSORS - 1)];
    const int kind = problem.sensor_objtype.data[sensor], element = problem.sensor_objid.data[sensor];
    const int other_kind = problem.sensor_reftype.data[sensor], other = problem.sensor_refid.data[sensor];
    const bool is_net = problem.sensor_intprm.data[sensor * problem.sensor_intprm.shape[1] + 1] == SUM;
    int found = 0, strongest = -1;
    float size = 0.0f, most = -1.0f, sign = 1.0f;
    vec3 force(0.0f), position(0.0f);
#pragma unroll 1
    for (int first = 0; first < contacts; first += LANES) {
        int read = 0, geom_read = 0, other_read = 0;
        vec3 force_read(0.0f), turned_read(0.0f), position_read(0.0f);
        if (first + lane < contacts) {
            read = listed[first + lane];
            geom_read = problem.contact_geom.data[read][0];
            other_read = problem.contact_geom.data[read][1];
            force_read = wrench_of(read).force;
            turned_read = in_world(read, force_read);
            position_read = problem.contact_pos.data[read];
        }
#pragma unroll 1
        for (int source = 0; source < wp::min(LANES, contacts - first); ++source) {
            const int contact = of_lane(read, source);
            const int geom = of_lane(geom_read, source), other_geom = of_lane(other_read, source);
            const vec3 own_force = vector_of_lane(force_read, source), turned = vector_of_lane(turned_read, source);
            const vec3 at = vector_of_lane(position_read, source);
            // In the direction of the contact, or against it.
            const bool along = is_of(geom, kind, element) && is_of(other_geom, other_kind, other);
            if (!along && !(is_of(other_geom, kind, element) && is_of(geom, other_kind, other)))
                continue;
            ++found;
            const float own_size = wp::dot(own_force, own_force), own_sign = along ? 1.0f : -1.0f;
            if (is_net) {
                const float weight = sqrtf(own_size);
                size += weight;
                position += weight * at;
                force += own_sign * turned;
            } else if (own_size > most) {
                // The axes of the contact are turned with it, all but the second tangent.
                most = own_size, sign = own_sign, strongest = contact;
                force = vec3(own_force[0], own_force[1], sign * own_force[2]);
                position = at;
            }
        }
    }
    if (place >= SENSORS || !found)
        continue;
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
}
