// The third part: H = M + J' D J, and the search direction - H^-1 slopes.

// M times the vector that the lanes share, of which each has its own entries.
auto times_mass = [&](float* result, const float* own) {
UNROLL
    for (int b = 0; b < BLOCKS; ++b) {
        float product = 0.0f;
UNROLL
        for (int j = 0; j < NV; ++j)
            product += mass[j * STRIDE + dof_of(b)] * shared[j];
        result[b] = fabsf(own[b]) <= LARGEST ? product : own[b];
    }
};
// J' force.
auto pull_back = [&] {
UNROLL
    for (int b = 0; b < BLOCKS; ++b) {
        pull[b] = 0.0f;
        each_row(0, 1, ByFours {}, [&](int row, const float* J) { pull[b] += J[dof_of(b)] * force[row]; });
    }
};
auto add_outer_product = [&](float scale, const float* vector) {
UNROLL
    for (int b = 0; b < BLOCKS; ++b) {
        const float weight = scale * vector[dof_of(b)];
        if (LANES == 1 && weight == 0.0f)
            continue;
UNROLL
        for (int j = b * LANES; j < NV; ++j)
            h[b][j] += weight * vector[j];
    }
};
// H = M + J' D J. A cone that slides adds, to the springs of its tangents, dm q q' - spring s s', where s is
// the direction of its slip and q = mu (normal - s).
auto build_h = [&] {
UNROLL
    for (int b = 0; b < BLOCKS; ++b)
UNROLL
        for (int j = b * LANES; j < NV; ++j)
            h[b][j] = mass[j * STRIDE + dof_of(b)];
    each_row(0, 1, Singly {}, [&](int row, const float* J) {
        if (v[row] > 0.0f)
            add_outer_product(v[row], J);
    });
    if (!ELLIPTIC)
        return;
    float* const q = columns;
    float* const s = columns + COLUMN;
#pragma unroll 1
    for (int unit = 0; unit < num_units; ++unit) {
        const int head = units[unit];
        const float dm = -v[head];
        if (dm <= 0.0f)
            continue;
        const float mu = bound[head], by_push = -1.0f / force[head];
UNROLL
        for (int b = 0; b < BLOCKS; ++b) {
            float slip = 0.0f;
#pragma unroll 1
            for (int mate = head + 1; mate < head + (kinds[head] >> 8); ++mate)
                slip += force[mate] * row_at(mate)[dof_of(b)];
            slip *= by_push;
            if (is_dof(b)) {
                s[dof_of(b)] = slip;
                q[dof_of(b)] = mu * (row_at(head)[dof_of(b)] - slip);
            }
        }
        sync();
        add_outer_product(dm, q);
        add_outer_product(-cones[4 * head], s);
        sync();
    }
};
// Cholesky (H = L D L') of the rows of H in place, and y of L y = slopes in the place of the slopes. The
// columns of a whole block are eliminated in passes of the same code, which has to stay in the instruction
// cache: after a pass the registers of a row rotate, so that the next columns lie where the last ones did,
// and in the end all are in place.
auto eliminate = [&](auto block) {
    const int own = block.INDEX;
    const int begin = own * LANES, size = wp::min(LANES, NV - begin), end = begin + size;
    const int passes = size == 32 ? 4 : 1, width = size / passes;
    // Where a shared column has the entries beyond the block; before them are those of the block, in passes
    // twice.
    const int beyond = passes > 1 ? size - begin : -begin;
#pragma unroll 1
    for (int pass = 0; pass < passes; ++pass) {
UNROLL
        for (int slot = 0; slot < width; ++slot) {
            const int at = pass * width + slot;
            float* const column = columns + (slot & 1) * COLUMN;
            if (is_dof(own)) {
                column[lane] = h[own][begin + slot];
                if (passes > 1)
                    column[size + lane] = h[own][begin + slot];
            }
            if (lane == at) {
                column[beyond + NV] = bounded(slopes[own]);
UNROLL
                for (int j = end; j < NV; ++j)
                    column[beyond + j] = h[own][j];
            }
            sync();
            const float by_pivot = 1.0f / wp::max(column[at], TINY);
UNROLL
            for (int b = own; b < BLOCKS; ++b) {
                const bool below = b > own || lane > at;
                const float entry = b == own ? h[own][begin + slot] : column[beyond + dof_of(b)];
                const float factor = below ? entry * by_pivot : 0.0f;
                if (b == own && lane == at)
                    inverse[own] = by_pivot;
                slopes[b] -= factor * column[beyond + NV];
                if (LANES == 1 && factor == 0.0f)
                    continue;
                if (b == own)
UNROLL
                    for (int k = slot + 1; k < size; ++k)
                        h[own][begin + k] -= factor * column[pass * width + k];
UNROLL
                for (int j = wp::max(end, b * LANES); j < NV; ++j)
                    h[b][j] -= factor * column[beyond + j];
            }
        }
        if (passes > 1) {
            float first[LANES];
UNROLL
            for (int k = 0; k < size; ++k)
                first[k] = h[own][begin + k];
UNROLL
            for (int k = 0; k < size; ++k)
                h[own][begin + k] = first[(k + width) % size];
        }
    }
};
struct FirstBlock {
    enum { INDEX = 0 };
};
struct SecondBlock {
    enum { INDEX = 1 };
};
struct Block {
    int INDEX;
};
auto factorize = [&] {
#if defined(__CUDA_ARCH__)
    eliminate(FirstBlock {});
    if (BLOCKS > 1)
        eliminate(SecondBlock {});
#else
    for (int block = 0; block < BLOCKS; ++block)
        eliminate(Block {block});
#endif
};
// The search direction, the negated solution of D L' x = y, in the place of y and for all lanes to read.
auto back_substitute = [&] {
UNROLL
    for (int c = NV - 1; c > 0; --c) {
        const int own = c / LANES;
        const float found = of_lane(bounded(slopes[own] * inverse[own]), c % LANES);
UNROLL
        for (int b = 0; b <= own; ++b)
            if (b * LANES + lane < c)
                slopes[b] -= h[b][c] * found;
    }
UNROLL
    for (int b = 0; b < BLOCKS; ++b) {
        slopes[b] *= -inverse[b];
        if (is_dof(b))
            shared[dof_of(b)] = bounded(slopes[b]);
    }
    sync();
};
