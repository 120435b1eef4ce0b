// Part 3 of the integration: its solution by L' D L = M - h dF/dv (computation chapter, "Inertia factorization"), whose
// L has entries where M has some. Degrees of freedom are eliminated from the last to the first: each takes from the
// rows of its ancestors, among which that of the n-th has the columns of the first n. In each of these turns another lane
// has each entry that changes, so that an entry is summed in the order of elimination. A table says which entry of the
// system, in its upper bits, takes the product of which two of the row; the right side stands in it as one more row.

if (SOLVES) {
#pragma unroll 1
    for (int i = 0; i < problem.eliminated.shape[0]; ++i) {
        const int dof = look_up(problem.eliminated, i), ancestors = num_ancestors(dof);
        const float* const row = system + row_start(dof);
        const float inverse = 1.0f / row[ancestors];
#pragma unroll 2
        for (int item = look_up(problem.first_change, i) + lane; item < look_up(problem.first_change, i + 1); item += LANES) {
            const int change = look_up(problem.changes, item), other = change & 127;
            const float factor = row[change >> 7 & 127] * inverse;
            system[change >> 14] -= factor * (other < ancestors ? row[other] : right[dof]);
        }
        sync();
    }
    // From the roots to the leaves; lanes whose chains share a degree of freedom find and write the same.
    each(problem.leaves.shape[0], [&](int leaf) {
        const int last = look_up(problem.leaves, leaf), chain = row_start(last);
#pragma unroll 1
        for (int place = 0; place <= num_ancestors(last); ++place) {
            const int dof = look_up(problem.M_colind, chain + place);
            const float* const row = system + row_start(dof);
            float sum = right[dof];
#pragma unroll 4
            for (int before = 0; before < place; ++before)
                sum -= row[before] * qacc[look_up(problem.M_colind, chain + before)];
            qacc[dof] = sum / row[place];
        }
    });
    sync();
} else {
    each(NUM_DOFS, [&](int dof) { qacc[dof] = row_of(problem.qacc)[dof]; });
    sync();
}
