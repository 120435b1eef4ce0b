// Part 4: the Hessian of a world in which no row touches two limbs, along the kinematic tree. Like M, it then couples no
// two limbs: eliminated from the limbs to the trunk, as mj_factorI goes from the leaves to the root, it has no fill-in
// (computation chapter, "Inverse inertia"; engine_core_smooth.c).
//
// With the gradient as one more row below the trunk's, the Cholesky factor of limb k and its neighbours is
//
//     [ H_k   A_k' ]   [ L_k    ] [ L_k'  Z_k' ]
//     [ A_k   T    ] = [ Z_k  I ] [     rest   ],   Z_k' = L_k^-1 A_k',   rest = T - sum of all Z_k Z_k',
//
// where L_k L_k' is taken from the last degree of freedom to the first. Each limb has a group of lanes, all with its
// factor in their registers and each with some columns of Z_k'. Then each lane sums some entries of the rest, and all
// lanes factorize that in their registers: within these steps no lane waits for another.
#pragma once
#include "ksim_rl/physics/newton/layout.cuh"

namespace newton {

constexpr int GROUP = LIMBS > 0 && LIMBS < LANES ? LANES / LIMBS : 1, GROUPS = LANES / GROUP;
constexpr bool TILED = TILE > 0 && LANES > 1;  // part 5 has shared out all but the gradient

CUDA_CALLABLE inline float* block_of(const Solve& s, int limb, int row)
{
    return s.limb_blocks + (limb * LIMB + row) * LIMB_STRIDE;
}

CUDA_CALLABLE inline float* arm_of(const Solve& s, int limb, int column)
{
    return s.limb_arms + (limb * ARMS + column) * LIMB_STRIDE;
}

CUDA_CALLABLE inline int entry_of(int row, int column)
{
    return row * (row + 1) / 2 + column;
}

// A pivot that rounding has eaten says nothing about its direction: the search leaves it out.
CUDA_CALLABLE inline float inverse_root(const Solve& s, float pivot)
{
    s.require(pivot > 0.0f, HESSIAN_IS_POSITIVE);
    return pivot > TINY ? 1.0f / sqrtf(pivot) : 0.0f;
}

// What a limb lacks of the longest has ones on the diagonal, and no other entries.
CUDA_CALLABLE inline void clear_limbs(const Solve& s)
{
#pragma unroll 1
    for (int entry = s.lane; entry < WORKSPACE + SPREAD; entry += LANES)
        s.columns[entry] = 0.0f;
    sync();
#pragma unroll 1
    for (int row = s.lane; row < LIMBS * LIMB; row += LANES)
        block_of(s, 0, row)[row % LIMB] = 1.0f;
    sync();
}

// Where a lane has narrow rows of the Hessian, of the trunk and a limb.
struct NarrowRows {
    static CUDA_CALLABLE void start(const Solve& s)
    {
UNROLL
        for (int block = 0; block < BLOCKS; ++block) {
            const float* const of_limb = s.mass + (s.slot_of(block) - wp::max(s.places[block] - LIMB_BEGIN, 0)) * STRIDE;
UNROLL
            for (int place = 0; place < TRUNK; ++place)
                s.own_row[block][place] = s.mass[place * STRIDE + s.slot_of(block)];
UNROLL
            for (int place = 0; place < LIMB; ++place)
                s.own_row[block][LIMB_BEGIN + place] = of_limb[place * STRIDE + s.slot_of(block)];
        }
    }

    static CUDA_CALLABLE void add(const Solve& s, float scale, float push, const float* vector, int limb)
    {
UNROLL
        for (int block = 0; block < BLOCKS; ++block) {
            const float own = s.touches(block, limb) ? vector[s.places[block]] : 0.0f, weight = scale * own;
            if ((LANES == 1 || block > 0) && lanes_where(own != 0.0f) == 0)
                continue;
            s.qfrc_constraint[block] += push * own;
UNROLL
            for (int place = 0; place < TRUNK; ++place)
                s.own_row[block][place] += weight * vector[place];
UNROLL
            for (int place = LIMB_BEGIN; place < LIMB_BEGIN + LIMB; ++place)
                s.own_row[block][place] += weight * vector[place];
        }
    }
};

CUDA_CALLABLE inline void share_own_rows(const Solve& s)
{
UNROLL
    for (int block = 0; block < BLOCKS; ++block) {
        const int place = s.places[block], limb = s.limbs[block];
        if (!s.is_dof(block))
            continue;
        if (limb < 0) {
UNROLL
            for (int other = 0; other < TRUNK; ++other)
                if (!TILED && other <= place)
                    s.trunk[entry_of(place, other)] = s.own_row[block][other];
            s.trunk[entry_of(TRUNK, place)] = bounded(s.gradient[block]);
        } else {
UNROLL
            for (int other = 0; other < (TILED ? 0 : TRUNK); ++other)
                arm_of(s, limb, other)[place - LIMB_BEGIN] = s.own_row[block][other];
            arm_of(s, limb, TRUNK)[place - LIMB_BEGIN] = bounded(s.gradient[block]);
UNROLL
            for (int other = 0; other < (TILED ? 0 : LIMB); ++other)
                block_of(s, limb, place - LIMB_BEGIN)[other] = s.own_row[block][LIMB_BEGIN + other];
        }
    }
    if (s.lane == 0)
        s.trunk[ENTRIES - 1] = 0.0f;
    sync();
}

// Returns gradient' H^-1 gradient.
CUDA_CALLABLE inline float factorize_limbs(const Solve& s)
{
    share_own_rows(s);
#pragma unroll 1
    for (int first = 0; first < LIMBS; first += GROUPS) {
        const int limb = wp::min(first + s.lane / GROUP, LIMBS - 1);
        const bool counts = first + s.lane / GROUP < LIMBS;
        float factor[LIMB][LIMB];
UNROLL
        for (int row = 0; row < LIMB; ++row)
UNROLL
            for (int column = 0; column <= row; ++column)
                factor[row][column] = block_of(s, limb, row)[column];
UNROLL
        for (int pivot = LIMB - 1; pivot >= 0; --pivot) {
            factor[pivot][pivot] = inverse_root(s, factor[pivot][pivot]);
UNROLL
            for (int row = 0; row < pivot; ++row)
                factor[pivot][row] *= factor[pivot][pivot];
UNROLL
            for (int row = 0; row < pivot; ++row)
UNROLL
                for (int column = 0; column <= row; ++column)
                    factor[row][column] -= factor[pivot][row] * factor[pivot][column];
        }
#pragma unroll 1
        for (int column = counts ? s.lane % GROUP : ARMS; column < ARMS; column += GROUP) {
            float arm[LIMB];
UNROLL
            for (int row = 0; row < LIMB; ++row)
                arm[row] = arm_of(s, limb, column)[row];
UNROLL
            for (int pivot = LIMB - 1; pivot >= 0; --pivot) {
                arm[pivot] = bounded(arm[pivot] * factor[pivot][pivot]);
UNROLL
                for (int row = 0; row < pivot; ++row)
                    arm[row] -= factor[pivot][row] * arm[pivot];
            }
UNROLL
            for (int row = 0; row < LIMB; ++row)
                arm_of(s, limb, column)[row] = arm[row];
        }
        sync();
        if (counts && s.lane % GROUP == 0)
UNROLL
            for (int row = 0; row < LIMB; ++row)
UNROLL
                for (int column = 0; column <= row; ++column)
                    block_of(s, limb, row)[column] = factor[row][column];
    }
#pragma unroll 1
    for (int entry = s.lane; entry < ENTRIES; entry += LANES) {
        const int row = (int)(0.5f * (sqrtf(8.0f * entry + 4.0f) - 1.0f)), column = entry - entry_of(row, 0);
        float sum = s.trunk[entry];
#pragma unroll 4
        for (int limb = 0; limb < LIMBS; ++limb)
UNROLL
            for (int place = 0; place < LIMB; ++place)
                sum -= arm_of(s, limb, row)[place] * arm_of(s, limb, column)[place];
        s.trunk[entry] = sum;
    }
    sync();
UNROLL
    for (int entry = 0; entry < ENTRIES; ++entry)
        s.rest[entry] = s.trunk[entry];
UNROLL
    for (int pivot = 0; pivot < TRUNK; ++pivot) {
        const float by_root = inverse_root(s, s.rest[entry_of(pivot, pivot)]);
        s.rest[entry_of(pivot, pivot)] = by_root;
UNROLL
        for (int row = pivot + 1; row < ARMS; ++row)
            s.rest[entry_of(row, pivot)] *= by_root;
        s.rest[entry_of(TRUNK, pivot)] = bounded(s.rest[entry_of(TRUNK, pivot)]);
UNROLL
        for (int row = pivot + 1; row < ARMS; ++row)
UNROLL
            for (int column = pivot + 1; column <= row; ++column)
                s.rest[entry_of(row, column)] -= s.rest[entry_of(row, pivot)] * s.rest[entry_of(column, pivot)];
    }
    return -s.rest[ENTRIES - 1];
}

// The search direction, from the trunk to the limbs: L_k' search = -(L_k^-1 gradient + Z_k' times the trunk's search).
CUDA_CALLABLE inline void search_along_limbs(const Solve& s)
{
    float of_trunk[ARMS];
UNROLL
    for (int column = TRUNK - 1; column >= 0; --column) {
        float found = -s.rest[entry_of(TRUNK, column)];
UNROLL
        for (int row = column + 1; row < TRUNK; ++row)
            found -= s.rest[entry_of(row, column)] * of_trunk[row];
        found *= s.rest[entry_of(column, column)];
        of_trunk[column] = bounded(found);
        if (s.lane == 0)
            s.spread[column] = found;
    }
#pragma unroll 1
    for (int first = 0; first < LIMBS; first += GROUPS)
#pragma unroll 1
        for (int row = first + s.lane / GROUP < LIMBS ? s.lane % GROUP : LIMB; row < LIMB; row += GROUP) {
            float sum = arm_of(s, first + s.lane / GROUP, TRUNK)[row];
UNROLL
            for (int column = 0; column < TRUNK; ++column)
                sum += arm_of(s, first + s.lane / GROUP, column)[row] * of_trunk[column];
            arm_of(s, first + s.lane / GROUP, TRUNK)[row] = sum;
        }
    sync();
#pragma unroll 1
    for (int limb = s.lane; limb < LIMBS; limb += LANES) {
        float found[LIMB];
UNROLL
        for (int row = 0; row < LIMB; ++row) {
            found[row] = -arm_of(s, limb, TRUNK)[row];
UNROLL
            for (int column = 0; column < row; ++column)
                found[row] -= block_of(s, limb, row)[column] * found[column];
            found[row] *= block_of(s, limb, row)[row];
            s.spread[LIMB_BEGIN + limb * LIMB_STRIDE + row] = found[row];
        }
    }
    sync();
UNROLL
    for (int block = 0; block < BLOCKS; ++block) {
        float* const place = s.spread + s.places[block] + wp::max(s.limbs[block], 0) * LIMB_STRIDE;
        s.search[block] = *place;
        if (s.is_dof(block))
            *place = s.shared[s.slot_of(block)] = bounded(s.search[block]);
    }
    sync();
}

}
