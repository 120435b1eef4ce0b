// Part 2: the constraint model. Reads M, and of each row J, D, aref, its kind and its bound.
//
// MuJoCo orders rows as equalities, dry friction, limits and contacts (computation chapter, "Constraint model").
// The rows of a contact with an elliptic cone stand one after another: that of the normal, here the head of the
// cone, and those of its tangents.

constexpr int MOST_OF_CONE = 6;
constexpr int EQUALITY = 0, FRICTION = 1, ONE_SIDED = 2, CONE_HEAD = 3, CONE_TANGENT = 4;
auto kind_by_order = [=](int row) {
    return row < equalities ? EQUALITY : row < equalities + frictions ? FRICTION : ONE_SIDED;
};
auto kind_of = [=](int row) { return ELLIPTIC ? kinds[row] & 15 : kind_by_order(row); };
// The units of which a cost is measured are all rows but equalities and tangents.
auto unit_of = [=](int unit) { return ELLIPTIC ? units[unit] : equalities + unit; };
const int* const slots = problem.slots.data;
const int* const place_of = by_limbs ? problem.places.data : slots;

#pragma unroll 1
for (int entry = lane; entry < NV * STRIDE; entry += LANES)
    mass[entry] = 0.0f;
each_row(0, 1, Singly {}, [&](int row, float* jacobian) {
#pragma unroll 1
    for (int place = lane; place < width; place += LANES)
        jacobian[place] = 0.0f;
});
UNROLL
for (int block = 0; block < BLOCKS; ++block) {
    qacc[block] = row_of(problem.qacc_warmstart)[dof_of(block)];
    qfrc_smooth[block] = row_of(problem.qfrc_smooth)[dof_of(block)];
    limbs[block] = by_limbs ? problem.limbs.data[dof_of(block)] : -1;
    places[block] = place_of[dof_of(block)];
    if (is_dof(block))
        shared[slot_of(block)] = bounded(qacc[block]);
}
sync();
#pragma unroll 4
for (int entry = lane; entry < problem.M_hinit_i.shape[0]; entry += LANES) {
    const int row = slots[problem.M_hinit_i.data[entry]], column = slots[problem.M_colind.data[entry]];
    mass[row * STRIDE + column] = mass[column * STRIDE + row] = row_of(problem.M)[entry];
}
each_row(lane, LANES, Singly {}, [&](int row, float* jacobian) {
    const int begin = row_of(problem.efc_J_rowadr)[row];
    const int end = begin + row_of(problem.efc_J_rownnz)[row];
    const float* const values = row_of(problem.efc_J);
    const int* const dofs = row_of(problem.efc_J_colind);
    float product = 0.0f;
#pragma unroll 4
    for (int entry = begin; entry < end; ++entry) {
        require(dofs[entry] >= 0 && dofs[entry] < NV, ROWS_ARE_WHOLE);
        jacobian[place_of[dofs[entry]]] = values[entry];
        product += values[entry] * shared[slots[dofs[entry]]];
    }
    residual[row] = product - row_of(problem.efc_aref)[row];
    efc_D[row] = row_of(problem.efc_D)[row];
    kinds[row] += kind_by_order(row);
    if (kind_of(row) == FRICTION)
        bound[row] = row_of(problem.efc_frictionloss)[row];
    require(efc_D[row] > 0.0f && (kind_of(row) != FRICTION || bound[row] >= 0.0f), ROWS_ARE_WHOLE);
    if (ELLIPTIC) {
        const int contact = contact_of[row];
        auto is_of_cone = [&](int mate) { return mate >= 0 && mate < rows && contact_of[mate] == contact; };
        if (contact >= 0) {
            const float* const friction = (const float*)(problem.contact_friction.data + contact);
            int before = 0, after = 1;
            while (is_of_cone(row - before - 1))
                ++before;
            while (is_of_cone(row + after))
                ++after;
            if (before + after < problem.contact_dim.data[contact]) {
                // Of a cone that njmax cuts off, no row pushes, as in mujoco_warp's solver.py (_eval_constraint).
                for (int entry = begin; entry < end; ++entry)
                    jacobian[place_of[dofs[entry]]] = 0.0f;
                residual[row] = efc_D[row] = 0.0f;
                return;
            }
            kinds[row] += (before > 0 ? CONE_TANGENT : CONE_HEAD) - ONE_SIDED;
            kinds[row] += ((before + after) << 4) + (before << 12);
            bound[row] = before > 0 ? friction[before - 1] : friction[0] * impratio;
            require(before + after >= 3 && before + after <= 6 && bound[row] > 0.0f, CONES_ARE_WHOLE);
        }
    }
});
sync();
#pragma unroll 1
for (int first = 0; ELLIPTIC && first < rows; first += LANES) {
    const int row = first + lane;
    const bool counts = row >= equalities && row < rows && kind_of(row) != CONE_TANGENT;
    const unsigned all = lanes_where(counts);
    if (counts)
        units[num_units + count_of(all & before)] = row;
    num_units += count_of(all);
}
sync();
