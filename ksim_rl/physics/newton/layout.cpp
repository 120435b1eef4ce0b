// Part 1: where the numbers of a world lie, and how its lanes share the work.
//
// These parts are the body of a function f(world, lane, problem), before which native.py and kernel.py put the
// constants of the kernel: sizes, MuJoCo's enums and its own invariants. They follow MuJoCo's chapter on computation
// (https://mujoco.readthedocs.io/en/stable/computation/index.html): constraint model, cost, gradient and Hessian,
// line search, Newton's method. There, r = J qacc - aref is the residual of the constraint rows, s(r) their cost,
// and qacc minimizes
//
//     1/2 (qacc - qacc_smooth)' M (qacc - qacc_smooth) + s(J qacc - aref),
//
// whose gradient is M qacc - qfrc_smooth - J' force with force = -ds/dr, and whose Hessian is M + J' d2s/dr2 J.
//
// The lanes of a world share out its degrees of freedom: lane l has l, l + LANES, ..., each of them a `block`. Of
// each it has the row of the Hessian from the block's first column on: on CUDA these rows lie in registers, and
// with one lane, on the CPU, they are the upper triangle. J and M lie on the chip as whole rows, zeros included:
// then sums over them have no index to look up, and the lanes read one address or adjacent ones.
//
// Here the degrees of freedom are in the order of their slots: the trunk of the kinematic tree, then its limbs (see
// limbs.py). Where no row of J touches two limbs, rows are narrow: the trunk's entries, then those of one limb.

world = problem.order.data[world];

#if defined(__CUDA_ARCH__)
#define UNROLL _Pragma("unroll")
#else
#define UNROLL
#endif

constexpr float TINY = 1e-15f, LARGEST = 3e38f;
constexpr float NOISE = 8.0f * 1.1920929e-07f;  // rounding of a sum of some float32 terms
constexpr int BLOCKS = (NV + LANES - 1) / LANES;
constexpr bool HAS_FAR_ROWS = ROWS_ON_CHIP * NARROW < NJ * STRIDE;  // some may find no room on the chip
constexpr int LIMB_BEGIN = (TRUNK + 3) / 4 * 4, LIMB_STRIDE = (LIMB + 3) / 4 * 4, PADDED_ROWS = (NJ + 3) / 4 * 4;

#if defined(__CUDA_ARCH__)
__shared__ __align__(16) float memory[FLOATS];
#else
alignas(16) static float memory[FLOATS];
#endif
float* const mass = memory;  // M
float* const chip = mass + NV * STRIDE;  // J of the rows that find room
float* const columns = chip + ROWS_ON_CHIP * NARROW;  // two, or what part 4 has of the Hessian
float* const spread = columns + WORKSPACE;  // `shared` with LIMB_STRIDE entries of each limb
float* const shared = spread + SPREAD;  // a vector of the degrees of freedom, for all lanes to read
float* const residual = shared + STRIDE;  // J qacc - aref
float* const rate = residual + PADDED_ROWS;  // J search, during a line search
float* const stiffness = rate;  // d2s/dr2, between two line searches; 0 where a row is slack
float* const force = rate + PADDED_ROWS;  // -ds/dr
int* const contact_of = (int*)force;  // of a row with a cone, or -1, until there are forces
float* const efc_D = force + PADDED_ROWS;
float* const bounds = efc_D + PADDED_ROWS;
// Of each row its kind, 16 times the rows of its cone, 256 times its limb, and 4096 times its place in the cone.
unsigned short* const kinds = (unsigned short*)(bounds + BOUNDS);
short* const units = (short*)kinds + PADDED_ROWS;  // with cones: the rows whose cost is measured
float* const cones = (float*)(units + PADDED_ROWS);
short* const listed = (short*)(memory + FLOATS) - PADDED_ROWS;  // with tiles (part 5): the rows, limb by limb

// What a lane has of the vectors of the degrees of freedom, and of the Hessian. The gradient, then y of
// L y = gradient, then the search direction stand in one place.
float qacc[BLOCKS], M_qacc[BLOCKS], M_search[BLOCKS], qfrc_smooth[BLOCKS], qfrc_constraint[BLOCKS];
float search[BLOCKS], inverse_pivot[BLOCKS];
auto& gradient = search;
float hessian[BLOCKS][NV];
int limbs[BLOCKS], places[BLOCKS];  // the limb of each, -1 in the trunk, and its place in a row

// The arrays of this world.
auto row_of = [=](auto& array) { return array.data + (size_t)world * array.shape[1]; };
auto of_world = [=](auto& array) { return array.data[world % array.shape[0]]; };
const int rows = wp::min(problem.nefc.data[world], NJ);
const int equalities = wp::min(problem.ne.data[world], rows), frictions = problem.nf.data[world];
float* const bound = bounds - equalities;  // most dry friction, mu of a cone's head, friction of its tangents
int num_units = ELLIPTIC ? 0 : rows - equalities;
const float impratio = of_world(problem.impratio_invsqrt);
const float tolerance = of_world(problem.tolerance);
const float ls_tolerance = of_world(problem.ls_tolerance);
int* const states = row_of(problem.efc_state);

// A debug build notes which invariants do not hold; any other one compiles to nothing here.
auto require = [&](bool holds, int invariant) {
    if (!CHECKED || holds)
        return;
#if defined(__CUDA_ARCH__)
    atomicOr(problem.broken.data + world, invariant);
#else
    problem.broken.data[world] |= invariant;
#endif
};
auto sync = [] {
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
};
auto total = [](float value) {
#if defined(__CUDA_ARCH__)
UNROLL
    for (int distance = LANES / 2; distance > 0; distance >>= 1)
        value += __shfl_xor_sync(0xffffffffu, value, distance);
    // A fused multiply-add may round the first sum otherwise in each lane: one of them speaks for all.
    value = __shfl_sync(0xffffffffu, value, 0);
#endif
    return value;
};
// What each lane has of four sums, added up over `lanes` neighbours, of which lane i then has the i-th. Lanes exchange
// what they do not go on with, so that a warp shuffles 6 times where four sums, one by one, take 20.
auto pooled = [=](float a, float b, float c, float d, int lanes) {
#if defined(__CUDA_ARCH__)
    const bool odd = lane & 1, late = lane & 2;
    const float ab = (odd ? b : a) + __shfl_xor_sync(0xffffffffu, odd ? a : b, 1);
    const float cd = (odd ? d : c) + __shfl_xor_sync(0xffffffffu, odd ? c : d, 1);
    a = (late ? cd : ab) + __shfl_xor_sync(0xffffffffu, late ? ab : cd, 2);
UNROLL
    for (int distance = 4; distance < lanes; distance <<= 1)
        a += __shfl_xor_sync(0xffffffffu, a, distance);
#endif
    return a;
};
// The lanes for which it holds, a bit for each; how many they are, and the first of them.
auto lanes_where = [](bool holds) -> unsigned {
#if defined(__CUDA_ARCH__)
    return __ballot_sync(0xffffffffu, holds);
#endif
    return holds;
};
auto count_of = [](unsigned lanes) -> int {
#if defined(__CUDA_ARCH__)
    return __popc(lanes);
#endif
    return lanes;
};
auto first_of = [](unsigned lanes) {
#if defined(__CUDA_ARCH__)
    return __ffs(lanes) - 1;
#endif
    return 0;
};
const unsigned before = (1u << lane) - 1u;  // the lanes before this one
auto across = [](float value, int distance) {
#if defined(__CUDA_ARCH__)
    value = __shfl_xor_sync(0xffffffffu, value, distance);
#endif
    return value;
};
auto of_lane = [](float value, int lane) {
#if defined(__CUDA_ARCH__)
    value = __shfl_sync(0xffffffffu, value, lane);
#endif
    return value;
};
// What overflows in one tree stays there: in the sums of another tree infinity times zero would be NaN.
auto bounded = [](float value) { return wp::clamp(value, -LARGEST, LARGEST); };
auto ratio = [](float dividend, float divisor) { return dividend / (divisor == 0.0f ? TINY : divisor); };
// A lane beyond the last degree of freedom does what the lane of the last one does, and writes nothing.
auto is_dof = [&](int block) { return block * LANES + lane < NV; };
auto slot_of = [&](int block) { return wp::min(block * LANES + lane, NV - 1); };
auto dof_of = [&](int block) { return problem.dofs.data[slot_of(block)]; };
auto cone_size = [&](int row) { return kinds[row] >> 4 & 15; };
auto limb_of = [&](int row) { return kinds[row] >> 8 & 15; };
auto head_of = [&](int row) { return row - (kinds[row] >> 12); };
auto touches = [&](int block, int limb) { return limbs[block] < 0 || limbs[block] == limb; };

bool couples = false;
#pragma unroll 1
for (int row = lane; row < rows; row += LANES) {
    const int begin = row_of(problem.efc_J_rowadr)[row], end = begin + row_of(problem.efc_J_rownnz)[row];
    int limb = -1;
#pragma unroll 4
    for (int entry = begin; entry < end; ++entry) {
        const int other = problem.limbs.data[row_of(problem.efc_J_colind)[entry]];
        couples |= limb >= 0 && other >= 0 && other != limb;
        limb = wp::max(limb, other);
    }
    kinds[row] = wp::max(limb, 0) << 8;
    if (ELLIPTIC)
        contact_of[row] = row_of(problem.efc_type)[row] == ELLIPTIC_CONTACT ? row_of(problem.efc_id)[row] : -1;
}
const bool by_limbs = LIMBS > 0 && lanes_where(couples) == 0;
const int width = by_limbs ? NARROW : STRIDE, near_rows = wp::min(rows, ROWS_ON_CHIP * NARROW / width);
float* const far = row_of(problem.scratch) - near_rows * width;
// Calls body(row, its J) for the rows first, first + stride, ...: those on chip, then those that found no
// room there.
struct Singly {
    enum { AT_ONCE = 1 };
};
struct ByFours {
    enum { AT_ONCE = 4 };
};
auto each_row = [&](int first, int stride, auto pace, auto body) {
#pragma unroll decltype(pace)::AT_ONCE
    for (int row = first; row < near_rows; row += stride)
        body(row, chip + row * width);
    if (HAS_FAR_ROWS)
#pragma unroll 1
        for (int row = near_rows + first; row < rows; row += stride)
            body(row, far + row * width);
};
auto jacobian_of = [&](int row) { return (row < near_rows ? chip : far) + row * width; };
