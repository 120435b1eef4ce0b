// Part 5: the sums of the Hessian and of J' force, where a limb has as many lanes as it and the trunk have degrees of
// freedom, or but one fewer. Then its lanes sum what its own rows add to H_k, A_k and T, a tile of the Hessian, and all
// limbs do so at once. Where limbs are larger, a lane for each degree of freedom is faster (part 4).
#pragma once
#include "ksim_rl/physics/newton/limbs.cuh"

namespace newton {

constexpr int TILE_LANES = TILED ? TILE : LANES, TILE_ROWS = TRUNK + LIMB, LAST = TILE_ROWS - 1;
constexpr bool HAS_LAST = TILE_ROWS > TILE_LANES;  // the last row has no lane: the other rows' lanes sum its entries

CUDA_CALLABLE inline void list_rows(Solve& s)
{
    int count = 0;
#pragma unroll 1
    for (int limb = 0; limb < LIMBS; ++limb) {
        int slot = 0, length = 0;
UNROLL
        for (int block = 0; block < BLOCKS; ++block) {
            slot += count_of(lanes_where(s.is_dof(block) && s.limbs[block] < limb));
            length += count_of(lanes_where(s.is_dof(block) && s.limbs[block] == limb));
        }
        const bool own = s.lane / TILE_LANES == limb;
        if (own) {
            s.tile_begin = count;
            s.tile_slot = slot;
            s.tile_length = length;
        }
#pragma unroll 1
        for (int first = 0; first < s.rows; first += LANES) {
            const bool counts = first + s.lane < s.rows && s.limb_of(first + s.lane) == limb;
            const Count found = lanes_with(s.lane, counts);
            if (counts)
                s.listed[count + found.before] = first + s.lane;
            count += found.all;
        }
        if (own)
            s.tile_end = count;
    }
    sync();
}

// In the curved zone of a cone (part 6) the terms along its slip follow its last row, from what its rows have left.
CUDA_CALLABLE inline void sum_tiles(const Solve& s)
{
    const int limb = wp::min(s.lane / TILE_LANES, LIMBS - 1), own = wp::min(s.lane % TILE_LANES, LAST);
    const int own_place = own < TRUNK ? own : own - TRUNK + LIMB_BEGIN;
    auto slot_in_tile = [&](int row) { return row < TRUNK ? row : row - TRUNK + s.tile_slot; };
    auto place_in_tile = [&](int row) { return row < TRUNK ? row : row - TRUNK + LIMB_BEGIN; };
    const float* const own_mass = s.mass + slot_in_tile(own) * STRIDE;
    float tile[TILE_ROWS], slip[TILE_ROWS];
    float corner = s.mass[slot_in_tile(LAST) * (STRIDE + 1)], pull = 0.0f, last_pull = 0.0f, own_slip = 0.0f;
UNROLL
    for (int row = 0; row < TILE_ROWS; ++row) {
        tile[row] = row < TRUNK && own < TRUNK && s.lane >= TILE_LANES ? 0.0f : own_mass[slot_in_tile(row)];
        slip[row] = 0.0f;
    }
    auto add_row = [&](int row, auto rows_at) {
        const float* const jacobian = rows_at(row);
        const float push = s.force[row], scale = wp::max(s.stiffness[row], 0.0f);
        if (s.stiffness[row] == 0.0f && push == 0.0f)
            return;
        float vector[TILE_ROWS];
UNROLL
        for (int other = 0; other < TILE_ROWS; ++other)
            vector[other] = jacobian[place_in_tile(other)];
        const float entry = jacobian[own_place], weight = scale * entry;
        pull += push * entry;
        last_pull += push * vector[LAST];
        corner += scale * vector[LAST] * vector[LAST];
UNROLL
        for (int other = 0; other < TILE_ROWS; ++other)
            tile[other] += weight * vector[other];
        if (!ELLIPTIC || s.kind_of(row) < CONE_HEAD)
            return;
        const int head = s.head_of(row);
        const float Dm = -s.stiffness[head];
        if (Dm <= 0.0f)
            return;
        if (row == head) {
            own_slip = 0.0f;
UNROLL
            for (int other = 0; other < TILE_ROWS; ++other)
                slip[other] = 0.0f;
            return;
        }
        const float along = -push / s.force[head];
        own_slip += along * entry;
UNROLL
        for (int other = 0; other < TILE_ROWS; ++other)
            slip[other] += along * vector[other];
        if (row + 1 < head + s.cone_size(row))
            return;
        const float stretch = Dm * s.bound[head] * s.bound[head], spring = s.cones[4 * head];
        const float* const of_head = rows_at(head);
        const float by_gap = stretch * (of_head[own_place] - own_slip), by_slip = -spring * own_slip;
UNROLL
        for (int other = 0; other < TILE_ROWS; ++other) {
            tile[other] += by_gap * (of_head[place_in_tile(other)] - slip[other]);
            tile[other] += by_slip * slip[other];
        }
        const float last_gap = of_head[place_in_tile(LAST)] - slip[LAST];
        corner += stretch * last_gap * last_gap - spring * slip[LAST] * slip[LAST];
    };
    int index = s.tile_begin;
#pragma unroll 1
    for (int row; index < s.tile_end && (row = s.listed[index]) < s.near_rows; ++index)
        add_row(row, [&](int near) { return s.near + near * NARROW; });
    if (ROWS_IN_SHARED < NJ)
#pragma unroll 1
        for (; index < s.tile_end; ++index)
            add_row(s.listed[index], [&](int other) { return s.jacobian_of(other); });

    float of_trunk = pull;
UNROLL
    for (int distance = TILE_LANES; distance < LANES; distance <<= 1) {
        of_trunk += across(of_trunk, distance);
UNROLL
        for (int column = 0; column < TRUNK; ++column) {
            const float others = across(tile[column], distance);
            tile[column] += own < TRUNK ? others : 0.0f;
        }
    }
    const int place = own - TRUNK;
    const bool in_tile = s.lane < LIMBS * TILE_LANES, has_last = HAS_LAST && in_tile && s.tile_length == LIMB;
    if (in_tile && s.lane % TILE_LANES < TILE_ROWS && own < TRUNK) {
UNROLL
        for (int column = 0; column < TRUNK; ++column)
            if (s.lane < TILE_LANES && column <= own)
                s.trunk[entry_of(own, column)] = tile[column];
        if (s.lane < TILE_LANES)
            s.spread[own] = of_trunk;
        if (has_last)
            arm_of(s, limb, own)[LIMB - 1] = tile[LAST];
    } else if (in_tile && s.lane % TILE_LANES < TILE_ROWS && place < s.tile_length) {
UNROLL
        for (int column = 0; column < TRUNK; ++column)
            arm_of(s, limb, column)[place] = tile[column];
UNROLL
        for (int column = 0; column < LIMB; ++column)
            block_of(s, limb, place)[column] = tile[TRUNK + column];
        if (has_last)
            block_of(s, limb, LIMB - 1)[place] = tile[LAST];
        s.spread[LIMB_BEGIN + limb * LIMB_STRIDE + place] = pull;
    }
    if (has_last && s.lane % TILE_LANES == 0) {
        block_of(s, limb, LIMB - 1)[LIMB - 1] = corner;
        s.spread[LIMB_BEGIN + limb * LIMB_STRIDE + LIMB - 1] = last_pull;
    }
    sync();
UNROLL
    for (int block = 0; block < BLOCKS; ++block)
        s.qfrc_constraint[block] = s.spread[s.places[block] + wp::max(s.limbs[block], 0) * LIMB_STRIDE];
}

}
