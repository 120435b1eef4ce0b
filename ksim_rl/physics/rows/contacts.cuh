// The rows of contacts.
//
// A contact of dimension 1 has the row of its normal. Others have with an elliptic cone rows of its normal and its
// tangents, and with a pyramidal one two rows for each tangent: normal + and - friction * tangent ("Contact"). Tangents are
// two of the plane, then rotations about the normal and about these two.
#pragma once
#include "ksim_rl/physics/rows/row.cuh"

namespace constraint_rows {

CUDA_CALLABLE inline int lowest_of(mask64 mask)
{
#if defined(__CUDA_ARCH__)
    return __ffsll(mask) - 1;
#else
    int bit = 0;
    for (; !(mask >> bit & 1); ++bit) {}
    return bit;
#endif
}

CUDA_CALLABLE inline int size_of(mask64 mask)
{
#if defined(__CUDA_ARCH__)
    return __popcll(mask);
#else
    int size = 0;
    for (; mask; mask &= mask - 1)
        ++size;
    return size;
#endif
}

CUDA_CALLABLE inline mask64 without_lowest(mask64 mask, int count)
{
    for (; count > 0; --count)
        mask &= mask - 1;
    return mask;
}

// The degrees of freedom that move one of two geoms and not the other.
CUDA_CALLABLE inline mask64 dofs_of(const Arguments& a, int contact)
{
    const auto& geoms = a.contact_geom.data[contact];
    return a.dofs_of_geom.data[geoms[0]] ^ a.dofs_of_geom.data[geoms[1]];
}

// All lanes write the nonzeros of one contact, side by side, in so many rows.
CUDA_CALLABLE inline void write_jacobian(const Rows& rows, int contact, int address, int count)
{
    const World& world = rows.world;
    const Arguments& a = rows.a;
    const mask64 dofs = dofs_of(a, contact), of_second = a.dofs_of_geom.data[a.contact_geom.data[contact][1]];
    const int nonzeros = size_of(dofs);
    const vec3 position = a.contact_pos.data[contact];
    const float* const axes = (const float*)(a.contact_frame.data + contact);
    const float* const friction = (const float*)(a.contact_friction.data + contact);
    auto along = [=](int axis, const vec3& v) {
        return axes[3 * axis] * v[0] + axes[3 * axis + 1] * v[1] + axes[3 * axis + 2] * v[2];
    };
    mask64 rest = without_lowest(dofs, world.lane);
#pragma unroll 1
    for (int nonzero = world.lane; nonzero < nonzeros; nonzero += LANES) {
        const int dof = lowest_of(rest);
        const auto& motion = world.row_of(a.cdof)[dof];
        const vec3 spin(motion[0], motion[1], motion[2]), glide(motion[3], motion[4], motion[5]);
        const vec3 arm = position - world.row_of(a.subtree_com)[a.body_rootid.data[a.dof_bodyid.data[dof]]];
        const float sign = of_second >> dof & 1 ? 1.0f : -1.0f;
        const vec3 rotation = sign * spin, translation = sign * (glide + wp::cross(spin, arm));
        auto rate = [&](int axis) { return axis < 3 ? along(axis, translation) : along(axis - 3, rotation); };
        const float normal = rate(0);
#pragma unroll 1
        for (int row = 0; row < count; ++row) {
            float value = normal;
            if (ELLIPTIC)
                value = row > 0 ? rate(row) : normal;
            else if (a.contact_dim.data[contact] > 1)
                value += (row % 2 ? -friction[row / 2] : friction[row / 2]) * rate(row / 2 + 1);
            rows.write_nonzero(address + row * nonzeros + nonzero, dof, value);
        }
        rest = without_lowest(rest, LANES);
    }
}

// Takes places for the rows of contacts, and writes their nonzeros.
CUDA_CALLABLE inline void place_contacts(Rows& rows, int contacts)
{
    const World& world = rows.world;
    const Arguments& a = rows.a;
    const int* const ids = world.row_of(a.ids);
    in_turns(world, CONTACTS ? contacts : 0, [&](int item, bool exists) {
        const int contact = exists ? ids[item] : 0;
        int count = 0, nonzeros = 0;
        // Not within the gap of a margin, nor where a margin was none.
        if (exists && a.contact_dist.data[contact] - a.contact_includemargin.data[contact] < 0.0f) {
            const int dim = a.contact_dim.data[contact];
            count = ELLIPTIC || dim == 1 ? dim : 2 * (dim - 1);
            nonzeros = size_of(dofs_of(a, contact));
        }
        const Place place = rows.reserve(count, nonzeros);
        for (int row = 0; row < place.rows; ++row) {
            rows.owners[place.row + row] = contact;
            world.row_of(a.efc_J_rownnz)[place.row + row] = nonzeros;
            world.row_of(a.efc_J_rowadr)[place.row + row] = place.address + row * nonzeros;
        }
        const int most = a.contact_efc_address.shape[1];
        for (int row = 0; exists && row < most; ++row)
            a.contact_efc_address.data[contact * most + row] = row < place.rows ? place.row + row : -1;
        const int present = wp::min(LANES, contacts - (item - world.lane));
#pragma unroll 1
        for (int source = 0; source < present; ++source) {
            const int written = of_lane(place.rows, source);
            const int of_source = of_lane(contact, source), address = of_lane(place.address, source);
            if (written > 0)
                write_jacobian(rows, of_source, address, written);
        }
    });
}

// Writes what else these rows have, from the first one on.
CUDA_CALLABLE inline void write_contacts(const Rows& rows, int first_contact_row)
{
    const World& world = rows.world;
    const Arguments& a = rows.a;
#pragma unroll 1
    for (int row = first_contact_row + world.lane; row < wp::min(rows.made, NJMAX); row += LANES) {
        const int contact = rows.owners[row], dim = a.contact_dim.data[contact];
        const int begin = world.row_of(a.efc_J_rowadr)[row], end = begin + world.row_of(a.efc_J_rownnz)[row];
        float velocity = 0.0f;
#pragma unroll 4
        for (int entry = begin; entry < end; ++entry)
            velocity += rows.jacobian[entry] * rows.qvel[rows.columns[entry]];
        const auto& geoms = a.contact_geom.data[contact];
        const auto* const weights = world.model_row(a.body_invweight0);
        const float* const friction = (const float*)(a.contact_friction.data + contact);
        const float margin = a.contact_includemargin.data[contact];
        const float distance = a.contact_dist.data[contact] - margin, to_root = world.of_world(a.impratio_invsqrt);
        const int tangent = row - a.contact_efc_address.data[contact * a.contact_efc_address.shape[1]];
        Row made = {dim == 1 ? CONTACT_FRICTIONLESS : ELLIPTIC ? CONTACT_ELLIPTIC : CONTACT_PYRAMIDAL, contact};
        made.position = distance;
        made.margin = margin;
        made.velocity = velocity;
        made.invweight = weights[a.geom_bodyid.data[geoms[0]]][0] + weights[a.geom_bodyid.data[geoms[1]]][0];
        made.frictionloss = 0.0f;
        made.softness = 1.0f;
        const auto& solimp = a.contact_solimp.data[contact];
        Law law = rows.law_of(a.contact_solref.data[contact], solimp, distance);
        if (ELLIPTIC && tangent > 0) {
            // A tangent has a damper only, and regularization of the normal by its friction and impratio.
            const auto& own = a.contact_solreffriction.data[contact];
            if (own[0] != 0.0f || own[1] != 0.0f)
                law.damping = rows.law_of(own, solimp, distance).damping;
            made.position = 0.0f;
            made.softness = to_root * to_root;
            if (tangent > 1)
                made.softness *= friction[0] * friction[0] / (friction[tangent - 1] * friction[tangent - 1]);
        } else if (!ELLIPTIC && dim > 1) {
            made.invweight += friction[0] * friction[0] * made.invweight;
            made.invweight *= 2.0f * friction[0] * friction[0] * to_root * to_root;
        }
        rows.write_row(row, made, law);
    }
}

}
