// Part 1: how the lanes of a world share its work.
//
// These parts are the body of a function f(world, lane, problem), before which native.py puts the constants.
// The lanes of a world are some of the threads of a warp. Worlds of a warp have other numbers of contacts, so that
// lanes wait for those of their own world only. Whatever the number of lanes, each place in memory is written by the
// same formula, and sums are added in one order: the results have the same bits.

auto row_of = [=](auto& array) { return array.data + (size_t)world * array.shape[1]; };
// Of a field of the model, which has one row for each world or one for all.
auto model_row = [=](auto& array) { return array.data + (array.shape[0] > 1 ? (size_t)world * array.shape[1] : 0); };
#if defined(__CUDA_ARCH__)
const unsigned own_lanes = (LANES == 32 ? 0xffffffffu : (1u << (LANES % 32)) - 1u) << (threadIdx.x % 32 / LANES * LANES);
#endif
auto sync = [=] {
#if defined(__CUDA_ARCH__)
    __syncwarp(own_lanes);
#endif
};
auto of_lane = [=](auto value, int source) {
#if defined(__CUDA_ARCH__)
    value = __shfl_sync(own_lanes, value, source, LANES);
#endif
    return value;
};
// The sum of what the lanes before this one have.
auto sum_before = [=](int value) {
    int sum = value;
#if defined(__CUDA_ARCH__)
    for (int distance = 1; distance < LANES; distance *= 2) {
        const int other = __shfl_up_sync(own_lanes, sum, distance, LANES);
        sum += lane >= distance ? other : 0;
    }
#endif
    return sum - value;
};
auto each = [&](int count, auto body) {
#pragma unroll 1
    for (int item = lane; item < count; item += LANES)
        body(item);
};
