// Part 6: the gradient M qacc - qfrc_smooth - J' force, the Hessian H = M + J' d2s/dr2 J, and the search direction
// -H^-1 gradient by a Cholesky factorization (computation chapter, "Algorithms", Newton): part 4's, or computed here for
// rows that touch any degrees of freedom.
#pragma once
#include "ksim_rl/physics/newton/tiles.cuh"

namespace newton {

// M times the vector that the lanes share, of which each has its own entries.
CUDA_CALLABLE inline void times_mass(const Solve& s, float (&result)[BLOCKS], const float (&own)[BLOCKS])
{
UNROLL
    for (int block = 0; block < BLOCKS; ++block) {
        float product = 0.0f;
#pragma unroll BLOCKS > 1 ? 7 : NV  // long code has to be fetched (H200, 32768 worlds of G1: 7.5 ms, 7.7 if unrolled)
        for (int dof = 0; dof < NV; ++dof)
            product += s.mass[dof * STRIDE + s.slot_of(block)] * s.shared[dof];
        result[block] = fabsf(own[block]) <= LARGEST ? product : own[block];
    }
}

// J' force.
CUDA_CALLABLE inline void pull_back(const Solve& s)
{
UNROLL
    for (int block = 0; block < BLOCKS; ++block) {
        s.qfrc_constraint[block] = 0.0f;
        s.each_row<4>(0, 1, [&](int row, const float* jacobian) {
            if (s.touches(block, s.limb_of(row)))
                s.qfrc_constraint[block] += jacobian[s.places[block]] * s.force[row];
        });
    }
}

// Where a lane has whole rows of the Hessian.
struct WholeRows {
    static CUDA_CALLABLE void start(const Solve& s)
    {
UNROLL
        for (int block = 0; block < BLOCKS; ++block)
UNROLL
            for (int dof = block * LANES; dof < NV; ++dof)
                s.hessian[block][dof] = s.mass[dof * STRIDE + s.slot_of(block)];
    }

    static CUDA_CALLABLE void add(const Solve& s, float scale, float push, const float* vector, int)
    {
UNROLL
        for (int block = 0; block < BLOCKS; ++block) {
            const float own = vector[s.slot_of(block)], weight = scale * own;
            if (LANES == 1 && own == 0.0f)
                continue;
            s.qfrc_constraint[block] += push * own;
UNROLL
            for (int dof = block * LANES; dof < NV; ++dof)
                s.hessian[block][dof] += weight * vector[dof];
        }
    }
};

// In the curved zone of a cone s = 1/2 Dm g^2 with g = N - mu T, so that
//
//     d2s = Dm dg dg' + Dm g d2g = Dm dg dg' + spring (I - t t'),   spring = force[0] / T,
//
// over the tangents scaled by their frictions, t being the direction of their slip. Of these terms spring I is the
// stiffness of the rows of the tangents. With slip = sum_i t[i] friction[i] J[i], the others are
// Dm gap gap' - spring slip slip', where gap = mu (J[0] - slip).
template <class Rows>
CUDA_CALLABLE inline void add_curved_cones(const Solve& s)
{
    float* const slip = s.spread - s.width;
    float* const gap = slip - s.width;
#pragma unroll 1
    for (int unit = 0; unit < s.num_units; ++unit) {
        const int head = s.units[unit];
        const float Dm = -s.stiffness[head];
        if (Dm <= 0.0f)
            continue;
        const float mu = s.bound[head], by_push = -1.0f / s.force[head];
UNROLL
        for (int block = 0; block < BLOCKS; ++block) {
            float along = 0.0f;
#pragma unroll 1
            for (int mate = head + 1; mate < head + s.cone_size(head); ++mate)
                along += s.force[mate] * s.jacobian_of(mate)[s.places[block]];
            along *= by_push;
            if (s.is_dof(block) && s.touches(block, s.limb_of(head))) {
                slip[s.places[block]] = along;
                gap[s.places[block]] = mu * (s.jacobian_of(head)[s.places[block]] - along);
            }
        }
        sync();
        Rows::add(s, Dm, 0.0f, gap, s.limb_of(head));
        Rows::add(s, -s.cones[4 * head], 0.0f, slip, s.limb_of(head));
        sync();
    }
}

// H = M + J' d2s/dr2 J, and J' force of the same rows, in rows of the Hessian that are this lane's `Rows`.
template <class Rows>
CUDA_CALLABLE inline void build_hessian(const Solve& s)
{
    Rows::start(s);
UNROLL
    for (int block = 0; block < BLOCKS; ++block)
        s.qfrc_constraint[block] = 0.0f;
    // Most rows are slack: lanes look for the others, each at a row of its own (H200, G1: 6 % of the substeps less).
    auto add_rows = [&](int begin, int end, const float* matrix) {
#pragma unroll 1
        for (int first = begin; first < end; first += LANES) {
            const int own = first + s.lane;
            unsigned found = lanes_where(own < end && (s.stiffness[own] != 0.0f || s.force[own] != 0.0f));
#pragma unroll 1
            for (; found != 0; found &= found - 1) {
                const int row = first + first_of(found);
                Rows::add(s, wp::max(s.stiffness[row], 0.0f), s.force[row], matrix + row * s.width, s.limb_of(row));
            }
        }
    };
    add_rows(0, s.near_rows, s.near);
    if (HAS_FAR_ROWS)
        add_rows(s.near_rows, s.rows, s.far);
    if (ELLIPTIC)
        add_curved_cones<Rows>(s);
}

// Cholesky (H = L D L') of the rows of H in place, and y of L y = gradient in the place of the gradient. The
// columns of a whole block are eliminated in passes of the same code, which has to stay in the instruction
// cache: after a pass the registers of a row rotate, so that the next columns lie where the last ones did,
// and in the end all are in place.
template <class Block>
CUDA_CALLABLE inline void eliminate(const Solve& s, Block own_block)
{
    const int own = own_block.INDEX;
    const int begin = own * LANES, size = wp::min(LANES, NV - begin), end = begin + size;
    const int passes = size == 32 ? 4 : 1, pass_width = size / passes;
    // Where a shared column has the entries beyond the block; before them are the block's entries, in passes
    // twice.
    const int beyond = passes > 1 ? size - begin : -begin;
#pragma unroll 1
    for (int pass = 0; pass < passes; ++pass) {
UNROLL
        for (int slot = 0; slot < pass_width; ++slot) {
            const int pivot = pass * pass_width + slot;
            float* const column = s.columns + (slot & 1) * COLUMN;
            if (s.is_dof(own)) {
                column[s.lane] = s.hessian[own][begin + slot];
                if (passes > 1)
                    column[size + s.lane] = s.hessian[own][begin + slot];
            }
            if (s.lane == pivot) {
                column[beyond + NV] = bounded(s.gradient[own]);
UNROLL
                for (int dof = end; dof < NV; ++dof)
                    column[beyond + dof] = s.hessian[own][dof];
            }
            sync();
            s.require(column[pivot] > 0.0f, HESSIAN_IS_POSITIVE);
            // A pivot that rounding has eaten says nothing about its direction: the search leaves it out.
            const float by_pivot = column[pivot] > TINY ? 1.0f / column[pivot] : 0.0f;
UNROLL
            for (int block = own; block < BLOCKS; ++block) {
                const bool below = block > own || s.lane > pivot;
                const float entry = block == own ? s.hessian[own][begin + slot] : column[beyond + s.slot_of(block)];
                const float factor = below ? entry * by_pivot : 0.0f;
                if (block == own && s.lane == pivot)
                    s.inverse_pivot[own] = by_pivot;
                s.gradient[block] -= factor * column[beyond + NV];
                if (LANES == 1 && factor == 0.0f)
                    continue;
                if (block == own)
UNROLL
                    for (int next = slot + 1; next < size; ++next)
                        s.hessian[own][begin + next] -= factor * column[pass * pass_width + next];
UNROLL
                for (int dof = wp::max(end, block * LANES); dof < NV; ++dof)
                    s.hessian[block][dof] -= factor * column[beyond + dof];
            }
        }
        if (passes > 1) {
            float first[LANES];
UNROLL
            for (int slot = 0; slot < size; ++slot)
                first[slot] = s.hessian[own][begin + slot];
UNROLL
            for (int slot = 0; slot < size; ++slot)
                s.hessian[own][begin + slot] = first[(slot + pass_width) % size];
        }
    }
}

// Blocks that the compiler knows, so that their rows stay in registers, and one that it does not.
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
CUDA_CALLABLE inline float factorize(const Solve& s)
{
#if defined(__CUDA_ARCH__)
    eliminate(s, FirstBlock {});
    if (BLOCKS > 1)
        eliminate(s, SecondBlock {});
#else
    for (int block = 0; block < BLOCKS; ++block)
        eliminate(s, AnyBlock {block});
#endif
    float decrement = 0.0f;
UNROLL
    for (int block = 0; block < BLOCKS; ++block)
        decrement += s.is_dof(block) ? s.gradient[block] * s.gradient[block] * s.inverse_pivot[block] : 0.0f;
    return total(decrement);
}

// The search direction, the negated solution of D L' search = y, in the place of y and for all lanes to read.
CUDA_CALLABLE inline void back_substitute(const Solve& s)
{
UNROLL
    for (int column = NV - 1; column > 0; --column) {
        const int own = column / LANES;
        const float found = of_lane(bounded(s.search[own] * s.inverse_pivot[own]), column % LANES);
UNROLL
        for (int block = 0; block <= own; ++block)
            if (block * LANES + s.lane < column)
                s.search[block] -= s.hessian[block][column] * found;
    }
UNROLL
    for (int block = 0; block < BLOCKS; ++block) {
        s.search[block] *= -s.inverse_pivot[block];
        if (s.is_dof(block))
            s.shared[s.slot_of(block)] = bounded(s.search[block]);
    }
    sync();
}

}
