// Part 5: the sums of the Hessian and of J' force, where a limb has as many lanes as it and the trunk have degrees of
// freedom, or but one fewer. Then its lanes sum what its own rows add to H_k, A_k and T, a tile of the Hessian, and all
// limbs do so at once. Where limbs are larger, a lane for each degree of freedom is faster (part 4).

constexpr int TILE_LANES = TILED ? TILE : LANES, TILE_ROWS = TRUNK + LIMB, LAST = TILE_ROWS - 1;
constexpr bool HAS_LAST = TILE_ROWS > TILE_LANES;  // the last row has no lane: those of the others sum its entries
int tile_begin = 0, tile_end = 0;  // where the rows of a lane's tile are listed
int tile_slot = 0, tile_length = 0;  // the slots of its limb

auto list_rows = [&] {
    int count = 0;
#pragma unroll 1
    for (int limb = 0; limb < LIMBS; ++limb) {
        int slot = 0, length = 0;
UNROLL
        for (int block = 0; block < BLOCKS; ++block) {
            slot += count_of(lanes_where(is_dof(block) && limbs[block] < limb));
            length += count_of(lanes_where(is_dof(block) && limbs[block] == limb));
        }
        const bool own = lane / TILE_LANES == limb;
        if (own) {
            tile_begin = count;
            tile_slot = slot;
            tile_length = length;
        }
#pragma unroll 1
        for (int first = 0; first < rows; first += LANES) {
            const bool counts = first + lane < rows && limb_of(first + lane) == limb;
            const unsigned all = lanes_where(counts);
            if (counts)
                listed[count + count_of(all & before)] = first + lane;
            count += count_of(all);
        }
        if (own)
            tile_end = count;
    }
    sync();
};
// In the curved zone of a cone (part 6) the terms along its slip follow its last row, from what its rows have left.
auto sum_tiles = [&] {
    const int limb = wp::min(lane / TILE_LANES, LIMBS - 1), own = wp::min(lane % TILE_LANES, LAST);
    const int own_place = own < TRUNK ? own : own - TRUNK + LIMB_BEGIN;
    auto slot_in_tile = [&](int row) { return row < TRUNK ? row : row - TRUNK + tile_slot; };
    auto place_in_tile = [&](int row) { return row < TRUNK ? row : row - TRUNK + LIMB_BEGIN; };
    const float* const own_mass = mass + slot_in_tile(own) * STRIDE;
    float tile[TILE_ROWS], slip[TILE_ROWS];
    float corner = mass[slot_in_tile(LAST) * (STRIDE + 1)], pull = 0.0f, last_pull = 0.0f, own_slip = 0.0f;
UNROLL
    for (int row = 0; row < TILE_ROWS; ++row) {
        tile[row] = row < TRUNK && own < TRUNK && lane >= TILE_LANES ? 0.0f : own_mass[slot_in_tile(row)];
        slip[row] = 0.0f;
    }
    auto add_row = [&](int row, auto rows_at) {
        const float* const jacobian = rows_at(row);
        const float push = force[row], scale = wp::max(stiffness[row], 0.0f);
        if (stiffness[row] == 0.0f && push == 0.0f)
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
        if (!ELLIPTIC || kind_of(row) < CONE_HEAD)
            return;
        const int head = head_of(row);
        const float Dm = -stiffness[head];
        if (Dm <= 0.0f)
            return;
        if (row == head) {
            own_slip = 0.0f;
UNROLL
            for (int other = 0; other < TILE_ROWS; ++other)
                slip[other] = 0.0f;
            return;
        }
        const float along = -push / force[head];
        own_slip += along * entry;
UNROLL
        for (int other = 0; other < TILE_ROWS; ++other)
            slip[other] += along * vector[other];
        if (row + 1 < head + cone_size(row))
            return;
        const float stretch = Dm * bound[head] * bound[head], spring = cones[4 * head];
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
    int index = tile_begin;
#pragma unroll 1
    for (int row; index < tile_end && (row = listed[index]) < near_rows; ++index)
        add_row(row, [=](int near) { return chip + near * NARROW; });
    if (ROWS_ON_CHIP < NJ)
#pragma unroll 1
        for (; index < tile_end; ++index)
            add_row(listed[index], jacobian_of);

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
    const bool in_tile = lane < LIMBS * TILE_LANES, has_last = HAS_LAST && in_tile && tile_length == LIMB;
    if (in_tile && lane % TILE_LANES < TILE_ROWS && own < TRUNK) {
UNROLL
        for (int column = 0; column < TRUNK; ++column)
            if (lane < TILE_LANES && column <= own)
                trunk[entry_of(own, column)] = tile[column];
        if (lane < TILE_LANES)
            spread[own] = of_trunk;
        if (has_last)
            arm_of(limb, own)[LIMB - 1] = tile[LAST];
    } else if (in_tile && lane % TILE_LANES < TILE_ROWS && place < tile_length) {
UNROLL
        for (int column = 0; column < TRUNK; ++column)
            arm_of(limb, column)[place] = tile[column];
UNROLL
        for (int column = 0; column < LIMB; ++column)
            block_of(limb, place)[column] = tile[TRUNK + column];
        if (has_last)
            block_of(limb, LIMB - 1)[place] = tile[LAST];
        spread[LIMB_BEGIN + limb * LIMB_STRIDE + place] = pull;
    }
    if (has_last && lane % TILE_LANES == 0) {
        block_of(limb, LIMB - 1)[LIMB - 1] = corner;
        spread[LIMB_BEGIN + limb * LIMB_STRIDE + LIMB - 1] = last_pull;
    }
    sync();
UNROLL
    for (int block = 0; block < BLOCKS; ++block)
        qfrc_constraint[block] = spread[places[block] + wp::max(limbs[block], 0) * LIMB_STRIDE];
};
