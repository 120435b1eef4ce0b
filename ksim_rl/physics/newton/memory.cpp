// The body of the function that solves one world, first part: where things are. newton_kernel.py puts the
// parts together, gives the arguments `world`, `lane` and `problem` and the constants that its `constants`
// lists, and says what it is about.
//
// The lanes of a world share out its degrees of freedom: lane l has l, l + LANES, ..., each of them a
// `block`. Of each it has the row of H from the block's first column on: on CUDA the rows of H lie in
// registers, and with one lane, on the CPU, they are the upper triangle. J and M lie on the chip as whole
// rows, zeros included: then sums over them have no index to look up, and the lanes read one address or
// adjacent ones.

#if defined(__CUDA_ARCH__)
#define UNROLL _Pragma("unroll")
#else
#define UNROLL
#endif

constexpr int EQUALITY = 0, FRICTION = 1, ONE_SIDED = 2, CONE_HEAD = 3, CONE_TANGENT = 4;
constexpr int SATISFIED = 0, QUADRATIC = 1, LINEAR_NEGATIVE = 2, LINEAR_POSITIVE = 3, CURVED = 4;
constexpr int ELLIPTIC_CONTACT = 7;
constexpr float TINY = 1e-15f, LARGEST = 3e38f;
constexpr float NOISE = 8.0f * 1.1920929e-07f;  // rounding of a sum of some float32 terms
constexpr int BLOCKS = (NV + LANES - 1) / LANES;

#if defined(__CUDA_ARCH__)
__shared__ __align__(16) float floats[WORLDS_PER_BLOCK * FLOATS];
float* const memory = floats + (threadIdx.x / LANES) * FLOATS;
#else
static float memory[FLOATS];
#endif
float* const mass = memory;
float* const chip = mass + NV * STRIDE;
float* const columns = chip + ROWS_ON_CHIP * STRIDE;  // two
float* const shared = columns + 2 * COLUMN;  // a vector of the degrees of freedom, for all lanes to read
float* const x = shared + STRIDE;
float* const v = x + PADDED_ROWS;  // between two line searches: the stiffness of the row, 0 where it is slack
float* const force = v + PADDED_ROWS;
float* const d = force + PADDED_ROWS;
float* const bound = d + PADDED_ROWS;  // most dry friction, mu of a cone's head, friction of its tangents
int* const kinds = (int*)(bound + PADDED_ROWS);
int* const units = kinds + PADDED_ROWS;  // the rows whose cost is measured: all but equalities and tangents
float* const cones = (float*)(units + PADDED_ROWS);
int num_units = 0;

// What a lane has of the vectors of the degrees of freedom, and of H.
float acc[BLOCKS], ma[BLOCKS], mv[BLOCKS], smooth[BLOCKS], pull[BLOCKS], slopes[BLOCKS], inverse[BLOCKS];
float h[BLOCKS][NV];

// The arrays of this world.
auto row_of = [=](auto& array) { return array.data + (size_t)world * array.shape[1]; };
auto of_world = [=](auto& array) { return array.data[world % array.shape[0]]; };
const int rows = wp::min(problem.nefc.data[world], NJ);
const int equalities = problem.ne.data[world], frictions = problem.nf.data[world];
const float impratio = of_world(problem.impratio_invsqrt);
const float tolerance = of_world(problem.tolerance);
const float ls_tolerance = of_world(problem.ls_tolerance);
int* const states = row_of(problem.efc_state);
const int near_rows = wp::min(rows, ROWS_ON_CHIP);
float* const far = row_of(problem.scratch) - near_rows * STRIDE;

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
        body(row, chip + row * STRIDE);
    if (ROWS_ON_CHIP < NJ)
#pragma unroll 1
        for (int row = near_rows + first; row < rows; row += stride)
            body(row, far + row * STRIDE);
};
auto row_at = [&](int row) { return (row < near_rows ? chip : far) + row * STRIDE; };
auto ratio = [](float a, float b) { return a / (b == 0.0f ? TINY : b); };
// A lane beyond the last degree of freedom does what the lane of the last one does, and writes nothing.
auto is_dof = [&](int block) { return block * LANES + lane < NV; };
auto dof_of = [&](int block) { return wp::min(block * LANES + lane, NV - 1); };
