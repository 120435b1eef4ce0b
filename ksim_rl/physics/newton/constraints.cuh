// Part 2: the constraint model. Reads M, and of each row J, D, aref, its kind and its bound.
//
// The rows of a contact with an elliptic cone stand one after another: the normal's, here the head of the
// cone, and its tangents'.
#pragma once
#include "ksim_rl/physics/newton/layout.cuh"

namespace newton {

// Where a row has the entry of each degree of freedom.
CUDA_CALLABLE inline const int* places_in_rows(const Solve& s)
{
    return s.by_limbs ? s.a.places.data : s.a.slots.data;
}

CUDA_CALLABLE inline void read_mass(const Solve& s)
{
    const int* const slots = s.a.slots.data;
#pragma unroll 4
    for (int entry = s.lane; entry < s.a.M_hinit_i.shape[0]; entry += LANES) {
        const int row = slots[s.a.M_hinit_i.data[entry]], column = slots[s.a.M_colind.data[entry]];
        s.mass[row * STRIDE + column] = s.mass[column * STRIDE + row] = s.row_of(s.a.M)[entry];
    }
}

// Says which row of its cone a row is, and takes its friction. Of a cone that njmax cuts off, no row pushes, as in
// mujoco_warp's solver.py (_eval_constraint).
CUDA_CALLABLE inline void read_row_of_cone(const Solve& s, int row, float* jacobian, int contact)
{
    auto is_of_cone = [&](int mate) { return mate >= 0 && mate < s.rows && s.contact_of[mate] == contact; };
    const float* const friction = (const float*)(s.a.contact_friction.data + contact);
    int before = 0, after = 1;
    while (is_of_cone(row - before - 1))
        ++before;
    while (is_of_cone(row + after))
        ++after;
    if (before + after < s.a.contact_dim.data[contact]) {
        const int begin = s.row_of(s.a.efc_J_rowadr)[row];
        const int end = begin + s.row_of(s.a.efc_J_rownnz)[row];
        for (int entry = begin; entry < end; ++entry)
            jacobian[places_in_rows(s)[s.row_of(s.a.efc_J_colind)[entry]]] = 0.0f;
        s.residual[row] = s.efc_D[row] = 0.0f;
    } else {
        s.kinds[row] += (before > 0 ? CONE_TANGENT : CONE_HEAD) - ONE_SIDED;
        s.kinds[row] += ((before + after) << 4) + (before << 12);
        s.bound[row] = before > 0 ? friction[before - 1] : friction[0] * s.impratio;
        s.require(before + after >= 3 && before + after <= MOST_OF_CONE && s.bound[row] > 0.0f, CONES_ARE_WHOLE);
    }
}

CUDA_CALLABLE inline void read_row(const Solve& s, int row, float* jacobian)
{
    const int begin = s.row_of(s.a.efc_J_rowadr)[row];
    const int end = begin + s.row_of(s.a.efc_J_rownnz)[row];
    const float* const values = s.row_of(s.a.efc_J);
    const int* const dofs = s.row_of(s.a.efc_J_colind);
    const int* const place_of = places_in_rows(s);
    float product = 0.0f;
#pragma unroll 4
    for (int entry = begin; entry < end; ++entry) {
        s.require(dofs[entry] >= 0 && dofs[entry] < NV, ROWS_ARE_WHOLE);
        jacobian[place_of[dofs[entry]]] = values[entry];
        product += values[entry] * s.shared[s.a.slots.data[dofs[entry]]];
    }
    s.residual[row] = product - s.row_of(s.a.efc_aref)[row];
    s.efc_D[row] = s.row_of(s.a.efc_D)[row];
    s.kinds[row] += s.kind_by_order(row);
    if (s.kind_of(row) == FRICTION)
        s.bound[row] = s.row_of(s.a.efc_frictionloss)[row];
    s.require(s.efc_D[row] > 0.0f && (s.kind_of(row) != FRICTION || s.bound[row] >= 0.0f), ROWS_ARE_WHOLE);
    if (ELLIPTIC && s.contact_of[row] >= 0)
        read_row_of_cone(s, row, jacobian, s.contact_of[row]);
}

// Lists the rows whose cost is measured, where cones have several rows each.
CUDA_CALLABLE inline void list_units(Solve& s)
{
#pragma unroll 1
    for (int first = 0; ELLIPTIC && first < s.rows; first += LANES) {
        const int row = first + s.lane;
        const bool counts = row >= s.equalities && row < s.rows && s.kind_of(row) != CONE_TANGENT;
        const Count found = lanes_with(s.lane, counts);
        if (counts)
            s.units[s.num_units + found.before] = row;
        s.num_units += found.all;
    }
    sync();
}

// Sets M and J, the warm start, and of each row what its cost depends on.
CUDA_CALLABLE inline void read_constraints(Solve& s)
{
#pragma unroll 1
    for (int entry = s.lane; entry < NV * STRIDE; entry += LANES)
        s.mass[entry] = 0.0f;
    s.each_row<1>(0, 1, [&](int, float* jacobian) {
#pragma unroll 1
        for (int place = s.lane; place < s.width; place += LANES)
            jacobian[place] = 0.0f;
    });
UNROLL
    for (int block = 0; block < BLOCKS; ++block) {
        s.qacc[block] = s.row_of(s.a.qacc_warmstart)[s.dof_of(block)];
        s.qfrc_smooth[block] = s.row_of(s.a.qfrc_smooth)[s.dof_of(block)];
        s.limbs[block] = s.by_limbs ? s.a.limbs.data[s.dof_of(block)] : -1;
        s.places[block] = places_in_rows(s)[s.dof_of(block)];
        if (s.is_dof(block))
            s.shared[s.slot_of(block)] = bounded(s.qacc[block]);
    }
    sync();
    read_mass(s);
    s.each_row<1>(s.lane, LANES, [&](int row, float* jacobian) { read_row(s, row, jacobian); });
    sync();
    list_units(s);
}

}
