// What the solver takes: arrays of a model and its worlds, and what is compiled into the kernel of a model.
#pragma once
#include "ksim_rl/device/lanes.cuh"

namespace newton {

namespace given {
// Sizes of the arrays that a world's lanes share, in floats (see `layout` in kernel.py).
constexpr int NV = 14;
constexpr int NJ = 64;  // rows
constexpr int STRIDE = 20;  // of rows of the inertia matrix, and of the Jacobian
constexpr int NARROW = 12;  // of rows of the Jacobian where none touches two limbs
constexpr int TRUNK = 6;  // degrees of freedom of the trunk
constexpr int LIMBS = 4;
constexpr int LIMB = 2;  // degrees of freedom of the longest limb
constexpr int SPREAD = 22;
constexpr int WORKSPACE = 176;
constexpr int COLUMN = 16;
constexpr int BOUNDS = 64;
constexpr int ROWS_IN_SHARED = 32;
constexpr int TILE = 8;  // lanes that sum the tile of a limb, or 0
constexpr int ELLIPTIC = 1;
constexpr int FLOATS = 1500;
// Limits.
constexpr int MOST_TRIALS = 50;
// Kinds and states of rows.
constexpr int ELLIPTIC_CONTACT = 7;
constexpr int SATISFIED = 0;
constexpr int QUADRATIC = 1;
constexpr int LINEAR_NEGATIVE = 2;
constexpr int LINEAR_POSITIVE = 3;
constexpr int CURVED = 4;
// Bits of overflow.
constexpr int OUT_OF_ITERATIONS = 64;
constexpr int OUT_OF_LS_ITERATIONS = 128;
// Whether this is a debug build, and the bits of the invariants that it looks at (see `Invariant` in kernel.py).
constexpr int CHECKED = 1;
constexpr int ROWS_ARE_WHOLE = 1;
constexpr int CONES_ARE_WHOLE = 2;
constexpr int FORCES_ARE_ADMISSIBLE = 4;
constexpr int HESSIAN_IS_POSITIVE = 8;
constexpr int SEARCH_DESCENDS = 16;
constexpr int COST_FALLS = 32;
}

using namespace given;
using namespace lanes;

// Unrolls a loop on a GPU, where arrays have to stay in registers; the CPU would only compile for longer.
#if defined(__CUDA_ARCH__)
#define UNROLL _Pragma("unroll")
#else
#define UNROLL
#endif

constexpr float TINY = 1e-15f, LARGEST = 3e38f;
constexpr float NOISE = 8.0f * 1.1920929e-07f;  // rounding of a sum of some float32 terms

struct Arguments {
    wp::array_t<int> order;  // in which the worlds are taken up
    wp::array_t<int> nefc;
    wp::array_t<int> ne;
    wp::array_t<int> nf;
    wp::array_t<float> impratio_invsqrt;
    wp::array_t<float> tolerance;
    wp::array_t<float> ls_tolerance;
    int iterations;
    wp::array_t<int> efc_state;
    wp::array_t<int> broken;  // invariants, as bits
    // Of each degree of freedom its limb, its slot and its place in narrow rows, and the degrees of freedom by slots.
    wp::array_t<int> limbs;
    wp::array_t<int> slots;
    wp::array_t<int> places;
    wp::array_t<int> dofs;
    wp::array_t<int> efc_J_rowadr;
    wp::array_t<int> efc_J_rownnz;
    wp::array_t<int> efc_J_colind;
    wp::array_t<float> efc_J;
    wp::array_t<int> efc_type;
    wp::array_t<int> efc_id;
    wp::array_t<float> scratch;  // rows that find no room in shared memory
    wp::array_t<float> qacc_warmstart;
    wp::array_t<float> qfrc_smooth;
    wp::array_t<int> M_hinit_i;
    wp::array_t<int> M_colind;
    wp::array_t<float> M;
    wp::array_t<float> efc_aref;
    wp::array_t<float> efc_D;
    wp::array_t<float> efc_frictionloss;
    wp::array_t<wp::vec_t<5, float>> contact_friction;
    wp::array_t<int> contact_dim;
    wp::array_t<int> overflow;
    wp::array_t<float> qacc;
    wp::array_t<float> efc_Ma;
    wp::array_t<float> qfrc_constraint;
    wp::array_t<float> efc_force;
    wp::array_t<int> solver_niter;
};

}
