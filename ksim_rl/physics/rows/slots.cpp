// What contact sensors of any kind read: some of nine fields, of some contacts by a reduction, also of those in a site. A
// lane reads a sensor, as the C engine does ("sensor-contact" in
// https://mujoco.readthedocs.io/en/stable/XMLreference.html#sensor-contact).

enum Field { FOUND, FORCE, TORQUE, DISTANCE, POSITION, NORMAL, TANGENT, VELOCITY, SPIN, FIELDS };
constexpr int SIZES[FIELDS] = {1, 3, 3, 1, 3, 3, 3, 3, 3};
constexpr int NONE = 0, NEAREST = 1, STRONGEST = 2, SUM = 3;

auto is_in_site = [=](int site, const vec3& point) {
    const vec3 inside = wp::mul(
        wp::transpose(row_of(problem.site_xmat)[site]), point - row_of(problem.site_xpos)[site]
    );
    const vec3 size = problem.site_size.data[site];
    const float x = inside[0], y = inside[1], z = inside[2], across = x * x + y * y;
    switch (problem.site_type.data[site]) {
    case SITE_SPHERE: return across + z * z < size[0] * size[0];
    case SITE_CAPSULE: {
        const float beyond = wp::max(wp::abs(z) - size[1], 0.0f);
        return across + beyond * beyond < size[0] * size[0];
    }
    case SITE_CYLINDER: return wp::abs(z) < size[1] && across < size[0] * size[0];
    case SITE_BOX: return wp::abs(x) < size[0] && wp::abs(y) < size[1] && wp::abs(z) < size[2];
    default: {
        const float a = x / size[0], b = y / size[1], c = z / size[2];
        return a * a + b * b + c * c < 1.0f;
    }
    }
};
// 0 where a sensor does not read a contact, else whether along it or against it.
auto sign_of = [&](int sensor, int contact) {
    const int kind = problem.sensor_objtype.data[sensor], element = problem.sensor_objid.data[sensor];
    const int other_kind = problem.sensor_reftype.data[sensor], other = problem.sensor_refid.data[sensor];
    if (kind == SITE && !is_in_site(element, problem.contact_pos.data[contact]))
        return 0;
    const int own_kind = kind == SITE ? NOTHING : kind;
    const auto& geoms = problem.contact_geom.data[contact];
    if (is_of(geoms[0], own_kind, element) && is_of(geoms[1], other_kind, other))
        return 1;
    return is_of(geoms[1], own_kind, element) && is_of(geoms[0], other_kind, other) ? -1 : 0;
};
// How fast a geom's body moves, at a place.
struct Motion {
    vec3 spin, glide;
};
auto motion_of = [&](int geom, const vec3& place) {
    const int body = problem.geom_bodyid.data[geom];
    const auto& velocity = row_of(problem.cvel)[body];
    const vec3 spin(velocity[0], velocity[1], velocity[2]), glide(velocity[3], velocity[4], velocity[5]);
    return Motion{spin, glide + wp::cross(spin, place - row_of(problem.subtree_com)[problem.body_rootid.data[body]])};
};
auto in_contact = [&](int contact, const vec3& v) {
    return vec3(wp::dot(v, axis_of(contact, 0)), wp::dot(v, axis_of(contact, 1)), wp::dot(v, axis_of(contact, 2)));
};

each(SENSORS, [&](int place) {
    const int sensor = problem.sensors.data[place];
    const int* const setting = problem.sensor_intprm.data + (size_t)sensor * problem.sensor_intprm.shape[1];
    const int fields = setting[0], reduction = setting[1], dim = problem.sensor_dim.data[sensor];
    float* const out = row_of(problem.sensordata) + problem.sensor_adr.data[sensor];
    int size = 0, found = 0;
    for (int field = 0; field < FIELDS; ++field)
        size += fields >> field & 1 ? SIZES[field] : 0;
    for (int i = 0; i < dim; ++i)
        out[i] = 0.0f;
    for (int i = 0; i < contacts; ++i)
        found += sign_of(sensor, listed[i]) != 0;
    if (!found)
        return;

    int next = 0;
    auto put = [&](Field field, const vec3& value) {
        for (int i = 0; fields >> field & 1 && i < SIZES[field]; ++i)
            out[next++] = value[i];
    };
    if (reduction == SUM) {
        vec3 force(0.0f), torque(0.0f), center(0.0f);
        float weight = 0.0f;
        for (int i = 0; i < contacts; ++i) {
            const float sign = (float)sign_of(sensor, listed[i]);
            if (sign == 0.0f)
                continue;
            const Wrench wrench = wrench_of(listed[i]);
            const vec3 own = sign * in_world(listed[i], wrench.force), at = problem.contact_pos.data[listed[i]];
            weight += wp::length(wrench.force);
            center += wp::length(wrench.force) * at;
            force += own;
            torque += sign * in_world(listed[i], wrench.torque) + wp::cross(at, own);
        }
        center = center / wp::max(weight, 1e-15f);
        put(FOUND, vec3((float)found));
        put(FORCE, force);
        put(TORQUE, torque - wp::cross(center, force));
        put(DISTANCE, vec3(0.0f));
        put(POSITION, center);
        put(NORMAL, vec3(1.0f, 0.0f, 0.0f));
        put(TANGENT, vec3(0.0f, 1.0f, 0.0f));
        return;
    }
    // Of equals the first of the list comes first.
    auto rank_of = [&](int contact) {
        if (reduction == NEAREST)
            return problem.contact_dist.data[contact];
        const vec3 force = reduction == STRONGEST ? wrench_of(contact).force : vec3(0.0f);
        return -wp::dot(force, force);
    };
    float last_rank = 0.0f;
    int last = -1;
    for (int slot = 0; slot < wp::min(found, dim / size); ++slot) {
        float best_rank = 0.0f;
        int best = -1;
        for (int i = 0; i < contacts; ++i) {
            if (!sign_of(sensor, listed[i]))
                continue;
            const float rank = rank_of(listed[i]);
            const bool is_later = slot == 0 || rank > last_rank || (rank == last_rank && i > last);
            if (is_later && (best < 0 || rank < best_rank))
                best = i, best_rank = rank;
        }
        if (best < 0)
            return;  // ranks that are no numbers
        last = best, last_rank = best_rank;
        const int contact = listed[best];
        // The axes of the contact are turned with it, all but the second tangent.
        const float sign = (float)sign_of(sensor, contact);
        auto turned = [=](const vec3& v) { return vec3(v[0], v[1], sign * v[2]); };
        const Wrench wrench = wrench_of(contact);
        const vec3 at = problem.contact_pos.data[contact];
        const auto& geoms = problem.contact_geom.data[contact];
        const Motion own = motion_of(geoms[0], at), other = motion_of(geoms[1], at);
        put(FOUND, vec3((float)found));
        put(FORCE, turned(wrench.force));
        put(TORQUE, turned(wrench.torque));
        put(DISTANCE, vec3(problem.contact_dist.data[contact]));
        put(POSITION, at);
        put(NORMAL, sign * axis_of(contact, 0));
        put(TANGENT, sign * axis_of(contact, 1));
        put(VELOCITY, turned(in_contact(contact, other.glide - own.glide)));
        put(SPIN, turned(in_contact(contact, other.spin - own.spin)));
    }
});
