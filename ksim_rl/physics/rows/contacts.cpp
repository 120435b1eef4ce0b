// Part 5: the rows of contacts, and what is counted of a world.
//
// A contact of dimension 1 has the row of its normal. Others have with an elliptic cone those of its normal and its
// tangents, and with a pyramidal one two for each tangent: normal + and - friction * tangent ("Contact"). Tangents are
// two of the plane, then rotations about the normal and about these two.

auto lowest_of = [](mask64 mask) {
#if defined(__CUDA_ARCH__)
    return __ffsll(mask) - 1;
#else
    int bit = 0;
    for (; !(mask >> bit & 1); ++bit) {}
    return bit;
#endif
};
auto size_of = [](mask64 mask) {
#if defined(__CUDA_ARCH__)
    return __popcll(mask);
#else
    int size = 0;
    for (; mask; mask &= mask - 1)
        ++size;
    return size;
#endif
};
auto without_lowest = [](mask64 mask, int count) {
    for (; count > 0; --count)
        mask &= mask - 1;
    return mask;
};
// The degrees of freedom that move one of two geoms and not the other.
auto dofs_of = [=](int contact) -> mask64 {
    const auto& geoms = problem.contact_geom.data[contact];
    return problem.dofs_of_geom.data[geoms[0]] ^ problem.dofs_of_geom.data[geoms[1]];
};
// All lanes write the nonzeros of one contact, side by side.
auto write_jacobian = [&](int contact, int address, int rows) {
    const mask64 dofs = dofs_of(contact), of_second = problem.dofs_of_geom.data[problem.contact_geom.data[contact][1]];
    const int nonzeros = size_of(dofs);
    const vec3 position = problem.contact_pos.data[contact];
    const float* const axes = (const float*)(problem.contact_frame.data + contact);
    const float* const friction = (const float*)(problem.contact_friction.data + contact);
    auto along = [=](int axis, const vec3& v) {
        return axes[3 * axis] * v[0] + axes[3 * axis + 1] * v[1] + axes[3 * axis + 2] * v[2];
    };
    mask64 rest = without_lowest(dofs, lane);
#pragma unroll 1
    for (int nonzero = lane; nonzero < nonzeros; nonzero += LANES) {
        const int dof = lowest_of(rest);
        const auto& motion = row_of(problem.cdof)[dof];
        const vec3 spin(motion[0], motion[1], motion[2]), glide(motion[3], motion[4], motion[5]);
        const vec3 arm = position - row_of(problem.subtree_com)[problem.body_rootid.data[problem.dof_bodyid.data[dof]]];
        const float sign = of_second >> dof & 1 ? 1.0f : -1.0f;
        const vec3 rotation = sign * spin, translation = sign * (glide + wp::cross(spin, arm));
        auto rate = [&](int axis) { return axis < 3 ? along(axis, translation) : along(axis - 3, rotation); };
        const float normal = rate(0);
#pragma unroll 1
        for (int row = 0; row < rows; ++row) {
            float value = normal;
            if (ELLIPTIC)
                value = row > 0 ? rate(row) : normal;
            else if (problem.contact_dim.data[contact] > 1)
                value += (row % 2 ? -friction[row / 2] : friction[row / 2]) * rate(row / 2 + 1);
            write_nonzero(address + row * nonzeros + nonzero, dof, value);
        }
        rest = without_lowest(rest, LANES);
    }
};

const int first_contact_row = rows_made;
in_turns(CONTACTS ? contacts : 0, [&](int item, bool exists) {
    const int contact = exists ? ids[item] : 0;
    int rows = 0, nonzeros = 0;
    // Not within the gap of a margin, nor where a margin was none.
    if (exists && problem.contact_dist.data[contact] - problem.contact_includemargin.data[contact] < 0.0f) {
        const int dim = problem.contact_dim.data[contact];
        rows = ELLIPTIC || dim == 1 ? dim : 2 * (dim - 1);
        nonzeros = size_of(dofs_of(contact));
    }
    const Place place = reserve(rows, nonzeros);
    for (int row = 0; row < place.rows; ++row) {
        owners[place.row + row] = contact;
        row_of(problem.efc_J_rownnz)[place.row + row] = nonzeros;
        row_of(problem.efc_J_rowadr)[place.row + row] = place.address + row * nonzeros;
    }
    const int most = problem.contact_efc_address.shape[1];
    for (int row = 0; exists && row < most; ++row)
        problem.contact_efc_address.data[contact * most + row] = row < place.rows ? place.row + row : -1;
    const int present = wp::min(LANES, contacts - (item - lane));
#pragma unroll 1
    for (int source = 0; source < present; ++source) {
        const int written = of_lane(place.rows, source);
        const int of_source = of_lane(contact, source), address = of_lane(place.address, source);
        if (written > 0)
            write_jacobian(of_source, address, written);
    }
});
sync();
#pragma unroll 1
for (int row = first_contact_row + lane; row < wp::min(rows_made, NJMAX); row += LANES) {
    const int contact = owners[row], dim = problem.contact_dim.data[contact];
    const int begin = row_of(problem.efc_J_rowadr)[row], end = begin + row_of(problem.efc_J_rownnz)[row];
    float velocity = 0.0f;
#pragma unroll 4
    for (int entry = begin; entry < end; ++entry)
        velocity += jacobian[entry] * qvel[columns[entry]];
    const auto& geoms = problem.contact_geom.data[contact];
    const auto* const weights = model_row(problem.body_invweight0);
    const float* const friction = (const float*)(problem.contact_friction.data + contact);
    const float margin = problem.contact_includemargin.data[contact];
    const float distance = problem.contact_dist.data[contact] - margin, to_root = of_world(problem.impratio_invsqrt);
    const int tangent = row - problem.contact_efc_address.data[contact * problem.contact_efc_address.shape[1]];
    Row made = {dim == 1 ? CONTACT_FRICTIONLESS : ELLIPTIC ? CONTACT_ELLIPTIC : CONTACT_PYRAMIDAL, contact};
    made.position = distance;
    made.margin = margin;
    made.velocity = velocity;
    made.invweight = weights[problem.geom_bodyid.data[geoms[0]]][0] + weights[problem.geom_bodyid.data[geoms[1]]][0];
    made.frictionloss = 0.0f;
    made.softness = 1.0f;
    const auto& solimp = problem.contact_solimp.data[contact];
    Law law = law_of(problem.contact_solref.data[contact], solimp, distance);
    if (ELLIPTIC && tangent > 0) {
        // A tangent has a damper only, and regularization of the normal by its friction and impratio.
        const auto& own = problem.contact_solreffriction.data[contact];
        if (own[0] != 0.0f || own[1] != 0.0f)
            law.damping = law_of(own, solimp, distance).damping;
        made.position = 0.0f;
        made.softness = to_root * to_root;
        if (tangent > 1)
            made.softness *= friction[0] * friction[0] / (friction[tangent - 1] * friction[tangent - 1]);
    } else if (!ELLIPTIC && dim > 1) {
        made.invweight += friction[0] * friction[0] * made.invweight;
        made.invweight *= 2.0f * friction[0] * friction[0] * to_root * to_root;
    }
    write_row(row, made, law);
}
if (lane == 0) {
    // Of contacts that the list had no room for it is only known how many rows they have at most.
    const int beyond = wp::max(0, appended - ROOM) * problem.contact_efc_address.shape[1];
    problem.ne.data[world] = equalities;
    problem.nf.data[world] = frictions;
    problem.nl.data[world] = limits;
    problem.nefc.data[world] = beyond > 0 ? wp::max(rows_made, NJMAX) + beyond : rows_made;
    if (nonzeros_asked > MOST_NONZEROS)
        problem.overflow.data[world] |= OUT_OF_NONZEROS;
}
