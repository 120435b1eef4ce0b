// Part 2 of the integration: its solution by L' D L = M - h dF/dv (computation chapter, "Inertia factorization"), whose
// L has entries where M has some. Degrees of freedom are eliminated from the last to the first: each takes from the
// rows of its ancestors, among which the n-th ancestor's row has the columns of the first n. In each of these turns
// another lane has each entry that changes, so that an entry is summed in the order of elimination. A table says which
// entry of the system, in its upper bits, takes the product of which two of the row; the right side stands in it as one
// more row.
#pragma once
#include "ksim_rl/physics/smooth/derivative.cuh"

namespace integration {

CUDA_CALLABLE inline void solve(const World& world, const Arguments& a, const SharedMemory& shared)
{
#pragma unroll 1
    for (int i = 0; i < a.eliminated.shape[0]; ++i) {
        const int dof = look_up(a.eliminated, i), ancestors = num_ancestors(a, dof);
        const float* const row = shared.system + row_start(a, dof);
        const float inverse = 1.0f / row[ancestors];
#pragma unroll 2
        for (int item = look_up(a.first_change, i) + world.lane; item < look_up(a.first_change, i + 1); item += LANES) {
            const int change = look_up(a.changes, item), other = change & 127;
            const float factor = row[change >> 7 & 127] * inverse;
            shared.system[change >> 14] -= factor * (other < ancestors ? row[other] : shared.right[dof]);
        }
        sync_warp();
    }
    // From the roots to the leaves; lanes whose chains share a degree of freedom find and write the same.
    world.each(a.leaves.shape[0], [&](int leaf) {
        const int last = look_up(a.leaves, leaf), chain = row_start(a, last);
#pragma unroll 1
        for (int place = 0; place <= num_ancestors(a, last); ++place) {
            const int dof = look_up(a.M_colind, chain + place);
            const float* const row = shared.system + row_start(a, dof);
            float sum = shared.right[dof];
#pragma unroll 4
            for (int before = 0; before < place; ++before)
                sum -= row[before] * shared.qacc[look_up(a.M_colind, chain + before)];
            shared.qacc[dof] = sum / row[place];
        }
    });
    sync_warp();
}

// The accelerations of the solver, where nothing changes them.
CUDA_CALLABLE inline void keep_accelerations(const World& world, const Arguments& a, const SharedMemory& shared)
{
    world.each(NUM_DOFS, [&](int dof) { shared.qacc[dof] = world.row_of(a.qacc)[dof]; });
    sync_warp();
}

}
