// Part 4: the Hessian of a world in which no row touches two limbs, along the kinematic tree. Like M, it then couples no
// two limbs: eliminated from the limbs to the trunk, as mj_factorI goes from the leaves to the root, it has no fill-in
// (computation chapter, "Inverse inertia"; engine_core_smooth.c).
//
// With the gradient as one more row below those of the trunk, the Cholesky factor of limb k and its neighbours is
//
//     [ H_k   A_k' ]   [ L_k    ] [ L_k'  Z_k' ]
//     [ A_k   T    ] = [ Z_k  I ] [     rest   ],   Z_k' = L_k^-1 A_k',   rest = T - sum of all Z_k Z_k',
//
// where L_k L_k' is taken from the last degree of freedom to the first. Each limb has a group of lanes, all with its
// factor in their registers and each with some columns of Z_k'. Then each lane sums some entries of the rest, and all
// lanes factorize that in their registers: within these steps no lane waits for another.

constexpr int GROUP = LIMBS > 0 && LIMBS < LANES ? LANES / LIMBS : 1, GROUPS = LANES / GROUP;
constexpr int ARMS = TRUNK + 1;  // columns of A_k', of which the last is that of the gradient
constexpr int ENTRIES = ARMS * (ARMS + 1) / 2;

constexpr bool TILED = TILE > 0 && LANES > 1;  // part 5 has shared out all but the gradient

float own_row[BLOCKS][NARROW];  // the trunk's entries of the Hessian's row, then the limb's
float rest[ENTRIES];
float* const limb_blocks = columns;  // H_k by rows, then L_k with the inverse of its diagonal
float* const limb_arms = limb_blocks + LIMBS * LIMB * LIMB_STRIDE;  // A_k', then Z_k', by columns
float* const trunk = limb_arms + LIMBS * ARMS * LIMB_STRIDE;  // T by rows, up to the diagonal

auto block_of = [&](int limb, int row) { return limb_blocks + (limb * LIMB + row) * LIMB_STRIDE; };
auto arm_of = [&](int limb, int column) { return limb_arms + (limb * ARMS + column) * LIMB_STRIDE; };
auto entry_of = [](int row, int column) { return row * (row + 1) / 2 + column; };
// A pivot that rounding has eaten says nothing about its direction: the search leaves it out.
auto inverse_root = [&](float pivot) {
    require(pivot > 0.0f, HESSIAN_IS_POSITIVE);
    return pivot > TINY ? 1.0f / sqrtf(pivot) : 0.0f;
};
// What a limb lacks of the longest has ones on the diagonal, and no other entries.
auto clear_limbs = [&] {
#pragma unroll 1
    for (int entry = lane; entry < WORKSPACE + SPREAD; entry += LANES)
        columns[entry] = 0.0f;
    sync();
#pragma unroll 1
    for (int row = lane; row < LIMBS * LIMB; row += LANES)
        block_of(0, row)[row % LIMB] = 1.0f;
    sync();
};
auto start_own_rows = [&] {
UNROLL
    for (int block = 0; block < BLOCKS; ++block) {
        const float* const of_limb = mass + (slot_of(block) - wp::max(places[block] - LIMB_BEGIN, 0)) * STRIDE;
UNROLL
        for (int place = 0; place < TRUNK; ++place)
            own_row[block][place] = mass[place * STRIDE + slot_of(block)];
UNROLL
        for (int place = 0; place < LIMB; ++place)
            own_row[block][LIMB_BEGIN + place] = of_limb[place * STRIDE + slot_of(block)];
    }
};
auto add_to_own_rows = [&](float scale, float push, const float* vector, int limb) {
UNROLL
    for (int block = 0; block < BLOCKS; ++block) {
        const float own = touches(block, limb) ? vector[places[block]] : 0.0f, weight = scale * own;
        if ((LANES == 1 || block > 0) && lanes_where(own != 0.0f) == 0)
            continue;
        qfrc_constraint[block] += push * own;
UNROLL
        for (int place = 0; place < TRUNK; ++place)
            own_row[block][place] += weight * vector[place];
UNROLL
        for (int place = LIMB_BEGIN; place < LIMB_BEGIN + LIMB; ++place)
            own_row[block][place] += weight * vector[place];
    }
};
auto share_own_rows = [&] {
UNROLL
    for (int block = 0; block < BLOCKS; ++block) {
        const int place = places[block], limb = limbs[block];
        if (!is_dof(block))
            continue;
        if (limb < 0) {
UNROLL
            for (int other = 0; other < TRUNK; ++other)
                if (!TILED && other <= place)
                    trunk[entry_of(place, other)] = own_row[block][other];
            trunk[entry_of(TRUNK, place)] = bounded(gradient[block]);
        } else {
UNROLL
            for (int other = 0; other < (TILED ? 0 : TRUNK); ++other)
                arm_of(limb, other)[place - LIMB_BEGIN] = own_row[block][other];
            arm_of(limb, TRUNK)[place - LIMB_BEGIN] = bounded(gradient[block]);
UNROLL
            for (int other = 0; other < (TILED ? 0 : LIMB); ++other)
                block_of(limb, place - LIMB_BEGIN)[other] = own_row[block][LIMB_BEGIN + other];
        }
    }
    if (lane == 0)
        trunk[ENTRIES - 1] = 0.0f;
    sync();
};
// Returns gradient' H^-1 gradient.
auto factorize_limbs = [&] {
    share_own_rows();
#pragma unroll 1
    for (int first = 0; first < LIMBS; first += GROUPS) {
        const int limb = wp::min(first + lane / GROUP, LIMBS - 1);
        const bool counts = first + lane / GROUP < LIMBS;
        float factor[LIMB][LIMB];
UNROLL
        for (int row = 0; row < LIMB; ++row)
UNROLL
            for (int column = 0; column <= row; ++column)
                factor[row][column] = block_of(limb, row)[column];
UNROLL
        for (int pivot = LIMB - 1; pivot >= 0; --pivot) {
            factor[pivot][pivot] = inverse_root(factor[pivot][pivot]);
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
        for (int column = counts ? lane % GROUP : ARMS; column < ARMS; column += GROUP) {
            float arm[LIMB];
UNROLL
            for (int row = 0; row < LIMB; ++row)
                arm[row] = arm_of(limb, column)[row];
UNROLL
            for (int pivot = LIMB - 1; pivot >= 0; --pivot) {
                arm[pivot] = bounded(arm[pivot] * factor[pivot][pivot]);
UNROLL
                for (int row = 0; row < pivot; ++row)
                    arm[row] -= factor[pivot][row] * arm[pivot];
            }
UNROLL
            for (int row = 0; row < LIMB; ++row)
                arm_of(limb, column)[row] = arm[row];
        }
        sync();
        if (counts && lane % GROUP == 0)
UNROLL
            for (int row = 0; row < LIMB; ++row)
UNROLL
                for (int column = 0; column <= row; ++column)
                    block_of(limb, row)[column] = factor[row][column];
    }
#pragma unroll 1
    for (int entry = lane; entry < ENTRIES; entry += LANES) {
        const int row = (int)(0.5f * (sqrtf(8.0f * entry + 4.0f) - 1.0f)), column = entry - entry_of(row, 0);
        float sum = trunk[entry];
#pragma unroll 4
        for (int limb = 0; limb < LIMBS; ++limb)
UNROLL
            for (int place = 0; place < LIMB; ++place)
                sum -= arm_of(limb, row)[place] * arm_of(limb, column)[place];
        trunk[entry] = sum;
    }
    sync();
UNROLL
    for (int entry = 0; entry < ENTRIES; ++entry)
        rest[entry] = trunk[entry];
UNROLL
    for (int pivot = 0; pivot < TRUNK; ++pivot) {
        const float by_root = inverse_root(rest[entry_of(pivot, pivot)]);
        rest[entry_of(pivot, pivot)] = by_root;
UNROLL
        for (int row = pivot + 1; row < ARMS; ++row)
            rest[entry_of(row, pivot)] *= by_root;
        rest[entry_of(TRUNK, pivot)] = bounded(rest[entry_of(TRUNK, pivot)]);
UNROLL
        for (int row = pivot + 1; row < ARMS; ++row)
UNROLL
            for (int column = pivot + 1; column <= row; ++column)
                rest[entry_of(row, column)] -= rest[entry_of(row, pivot)] * rest[entry_of(column, pivot)];
    }
    return -rest[ENTRIES - 1];
};
// The search direction, from the trunk to the limbs: L_k' search = -(L_k^-1 gradient + Z_k' times that of the trunk).
auto search_along_limbs = [&] {
    float of_trunk[ARMS];
UNROLL
    for (int column = TRUNK - 1; column >= 0; --column) {
        float found = -rest[entry_of(TRUNK, column)];
UNROLL
        for (int row = column + 1; row < TRUNK; ++row)
            found -= rest[entry_of(row, column)] * of_trunk[row];
        found *= rest[entry_of(column, column)];
        of_trunk[column] = bounded(found);
        if (lane == 0)
            spread[column] = found;
    }
#pragma unroll 1
    for (int first = 0; first < LIMBS; first += GROUPS)
#pragma unroll 1
        for (int row = first + lane / GROUP < LIMBS ? lane % GROUP : LIMB; row < LIMB; row += GROUP) {
            float sum = arm_of(first + lane / GROUP, TRUNK)[row];
UNROLL
            for (int column = 0; column < TRUNK; ++column)
                sum += arm_of(first + lane / GROUP, column)[row] * of_trunk[column];
            arm_of(first + lane / GROUP, TRUNK)[row] = sum;
        }
    sync();
#pragma unroll 1
    for (int limb = lane; limb < LIMBS; limb += LANES) {
        float found[LIMB];
UNROLL
        for (int row = 0; row < LIMB; ++row) {
            found[row] = -arm_of(limb, TRUNK)[row];
UNROLL
            for (int column = 0; column < row; ++column)
                found[row] -= block_of(limb, row)[column] * found[column];
            found[row] *= block_of(limb, row)[row];
            spread[LIMB_BEGIN + limb * LIMB_STRIDE + row] = found[row];
        }
    }
    sync();
UNROLL
    for (int block = 0; block < BLOCKS; ++block) {
        float* const place = spread + places[block] + wp::max(limbs[block], 0) * LIMB_STRIDE;
        search[block] = *place;
        if (is_dof(block))
            *place = shared[slot_of(block)] = bounded(search[block]);
    }
    sync();
};
