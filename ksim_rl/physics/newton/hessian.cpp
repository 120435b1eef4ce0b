// Part 6: the gradient M qacc - qfrc_smooth - J' force, the Hessian H = M + J' d2s/dr2 J, and the search direction
// -H^-1 gradient by a Cholesky factorization (computation chapter, "Algorithms", Newton): that of part 4, or here for
// rows that touch any degrees of freedom.

// M times the vector that the lanes share, of which each has its own entries.
auto times_mass = [&](float* result, const float* own) {
UNROLL
    for (int block = 0; block < BLOCKS; ++block) {
        float product = 0.0f;
#pragma unroll BLOCKS > 1 ? 7 : NV  // long code has to be fetched (H200, 32768 worlds of G1: 7.5 ms, 7.7 if unrolled)
        for (int dof = 0; dof < NV; ++dof)
            product += mass[dof * STRIDE + slot_of(block)] * shared[dof];
        result[block] = fabsf(own[block]) <= LARGEST ? product : own[block];
    }
};
// J' force.
auto pull_back = [&] {
UNROLL
    for (int block = 0; block < BLOCKS; ++block) {
        qfrc_constraint[block] = 0.0f;
        each_row(0, 1, ByFours {}, [&](int row, const float* jacobian) {
            if (touches(block, limb_of(row)))
                qfrc_constraint[block] += jacobian[places[block]] * force[row];
        });
    }
};
auto start_rows = [&] {
UNROLL
    for (int block = 0; block < BLOCKS; ++block)
UNROLL
        for (int dof = block * LANES; dof < NV; ++dof)
            hessian[block][dof] = mass[dof * STRIDE + slot_of(block)];
};
auto add_outer_product = [&](float scale, float push, const float* vector, int) {
UNROLL
    for (int block = 0; block < BLOCKS; ++block) {
        const float own = vector[slot_of(block)], weight = scale * own;
        if (LANES == 1 && own == 0.0f)
            continue;
        qfrc_constraint[block] += push * own;
UNROLL
        for (int dof = block * LANES; dof < NV; ++dof)
            hessian[block][dof] += weight * vector[dof];
    }
};
// H = M + J' d2s/dr2 J, and J' force of the same rows. In the curved zone of a cone s = 1/2 Dm g^2 with
// g = N - mu T, so that
//
//     d2s = Dm dg dg' + Dm g d2g = Dm dg dg' + spring (I - t t'),   spring = force[0] / T,
//
// over the tangents scaled by their frictions, t being the direction of their slip. Of these terms spring I is the
// stiffness of the rows of the tangents. With slip = sum_i t[i] friction[i] J[i], the others are
// Dm gap gap' - spring slip slip', where gap = mu (J[0] - slip).
auto build_hessian = [&](auto start, auto add) {
    start();
UNROLL
    for (int block = 0; block < BLOCKS; ++block)
        qfrc_constraint[block] = 0.0f;
    // Most rows are slack: lanes look for the others, each at a row of its own (H200, G1: 6 % of the substeps less).
    auto add_rows = [&](int begin, int end, const float* matrix) {
#pragma unroll 1
        for (int first = begin; first < end; first += LANES) {
            const int own = first + lane;
            unsigned found = lanes_where(own < end && (stiffness[own] != 0.0f || force[own] != 0.0f));
#pragma unroll 1
            for (; found != 0; found &= found - 1) {
                const int row = first + first_of(found);
                add(wp::max(stiffness[row], 0.0f), force[row], matrix + row * width, limb_of(row));
            }
        }
    };
    add_rows(0, near_rows, chip);
    if (HAS_FAR_ROWS)
        add_rows(near_rows, rows, far);
    if (!ELLIPTIC)
        return;
    float* const slip = spread - width;
    float* const gap = slip - width;
#pragma unroll 1
    for (int unit = 0; unit < num_units; ++unit) {
        const int head = units[unit];
        const float Dm = -stiffness[head];
        if (Dm <= 0.0f)
            continue;
        const float mu = bound[head], by_push = -1.0f / force[head];
UNROLL
        for (int block = 0; block < BLOCKS; ++block) {
            float along = 0.0f;
#pragma unroll 1
            for (int mate = head + 1; mate < head + cone_size(head); ++mate)
                along += force[mate] * jacobian_of(mate)[places[block]];
            along *= by_push;
            if (is_dof(block) && touches(block, limb_of(head))) {
                slip[places[block]] = along;
                gap[places[block]] = mu * (jacobian_of(head)[places[block]] - along);
            }
        }
        sync();
        add(Dm, 0.0f, gap, limb_of(head));
        add(-cones[4 * head], 0.0f, slip, limb_of(head));
        sync();
    }
};
// Cholesky (H = L D L') of the rows of H in place, and y of L y = gradient in the place of the gradient. The
// columns of a whole block are eliminated in passes of the same code, which has to stay in the instruction
// cache: after a pass the registers of a row rotate, so that the next columns lie where the last ones did,
// and in the end all are in place.
auto eliminate = [&](auto own_block) {
    const int own = own_block.INDEX;
    const int begin = own * LANES, size = wp::min(LANES, NV - begin), end = begin + size;
    const int passes = size == 32 ? 4 : 1, width = size / passes;
    // Where a shared column has the entries beyond the block; before them are those of the block, in passes
    // twice.
    const int beyond = passes > 1 ? size - begin : -begin;
#pragma unroll 1
    for (int pass = 0; pass < passes; ++pass) {
UNROLL
        for (int slot = 0; slot < width; ++slot) {
            const int pivot = pass * width + slot;
            float* const column = columns + (slot & 1) * COLUMN;
            if (is_dof(own)) {
                column[lane] = hessian[own][begin + slot];
                if (passes > 1)
                    column[size + lane] = hessian[own][begin + slot];
            }
            if (lane == pivot) {
                column[beyond + NV] = bounded(gradient[own]);
UNROLL
                for (int dof = end; dof < NV; ++dof)
                    column[beyond + dof] = hessian[own][dof];
            }
            sync();
            require(column[pivot] > 0.0f, HESSIAN_IS_POSITIVE);
            // A pivot that rounding has eaten says nothing about its direction: the search leaves it out.
            const float by_pivot = column[pivot] > TINY ? 1.0f / column[pivot] : 0.0f;
UNROLL
            for (int block = own; block < BLOCKS; ++block) {
                const bool below = block > own || lane > pivot;
                const float entry = block == own ? hessian[own][begin + slot] : column[beyond + slot_of(block)];
                const float factor = below ? entry * by_pivot : 0.0f;
                if (block == own && lane == pivot)
                    inverse_pivot[own] = by_pivot;
                gradient[block] -= factor * column[beyond + NV];
                if (LANES == 1 && factor == 0.0f)
                    continue;
                if (block == own)
UNROLL
                    for (int next = slot + 1; next < size; ++next)
                        hessian[own][begin + next] -= factor * column[pass * width + next];
UNROLL
                for (int dof = wp::max(end, block * LANES); dof < NV; ++dof)
                    hessian[block][dof] -= factor * column[beyond + dof];
            }
        }
        if (passes > 1) {
            float first[LANES];
UNROLL
            for (int slot = 0; slot < size; ++slot)
                first[slot] = hessian[own][begin + slot];
UNROLL
            for (int slot = 0; slot < size; ++slot)
                hessian[own][begin + slot] = first[(slot + width) % size];
        }
    }
};
struct FirstBlock {
    enum { INDEX = 0 };
};
struct SecondBlock {
    enum { INDEX = 1 };
};
struct AnyBlock {
    int INDEX;
};
// Returns gradient' H^-1 gradient, from y and D of L D L' = H.
auto factorize = [&] {
#if defined(__CUDA_ARCH__)
    eliminate(FirstBlock {});
    if (BLOCKS > 1)
        eliminate(SecondBlock {});
#else
    for (int block = 0; block < BLOCKS; ++block)
        eliminate(AnyBlock {block});
#endif
    float decrement = 0.0f;
UNROLL
    for (int block = 0; block < BLOCKS; ++block)
        decrement += is_dof(block) ? gradient[block] * gradient[block] * inverse_pivot[block] : 0.0f;
    return total(decrement);
};
// The search direction, the negated solution of D L' search = y, in the place of y and for all lanes to read.
auto back_substitute = [&] {
UNROLL
    for (int column = NV - 1; column > 0; --column) {
        const int own = column / LANES;
        const float found = of_lane(bounded(search[own] * inverse_pivot[own]), column % LANES);
UNROLL
        for (int block = 0; block <= own; ++block)
            if (block * LANES + lane < column)
                search[block] -= hessian[block][column] * found;
    }
UNROLL
    for (int block = 0; block < BLOCKS; ++block) {
        search[block] *= -inverse_pivot[block];
        if (is_dof(block))
            shared[slot_of(block)] = bounded(search[block]);
    }
    sync();
};
