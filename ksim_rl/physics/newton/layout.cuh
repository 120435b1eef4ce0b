// Part 1: where the numbers of a world lie, and how its lanes share the work.
//
// The solver follows MuJoCo's chapter on computation
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
// with one lane, on the CPU, they are the upper triangle. J and M lie in shared memory as whole rows, zeros included:
// then sums over them have no index to look up, and the lanes read one address or adjacent ones.
//
// Here the degrees of freedom are in the order of their slots: the trunk of the kinematic tree, then its limbs (see
// limbs.py). Where no row of J touches two limbs, rows are narrow: the trunk's entries, then one limb's.
#pragma once
#include "ksim_rl/physics/newton/exchange.cuh"

namespace newton {

constexpr int BLOCKS = (NV + LANES - 1) / LANES;
constexpr bool HAS_FAR_ROWS = ROWS_IN_SHARED * NARROW < NJ * STRIDE;  // some may find no room in shared memory
constexpr int LIMB_BEGIN = (TRUNK + 3) / 4 * 4, LIMB_STRIDE = (LIMB + 3) / 4 * 4, PADDED_ROWS = (NJ + 3) / 4 * 4;
constexpr int ARMS = TRUNK + 1;  // columns of what couples a limb to the trunk, of which the last is the gradient's
constexpr int ENTRIES = ARMS * (ARMS + 1) / 2;
// What a row of constraints is of; a cone has a head, the row of its normal, and tangents.
constexpr int EQUALITY = 0, FRICTION = 1, ONE_SIDED = 2, CONE_HEAD = 3, CONE_TANGENT = 4;
constexpr int MOST_OF_CONE = 6;

// Shared memory of a world.
struct SharedMemory {
    float* const mass;       // M
    float* const near;       // J of the rows that find room
    float* const columns;    // two, or what part 4 has of the Hessian
    float* const spread;     // `shared` with LIMB_STRIDE entries of each limb
    float* const shared;     // a vector of the degrees of freedom, for all lanes to read
    float* const residual;   // J qacc - aref
    float* const rate;       // J search, during a line search
    float* const stiffness;  // d2s/dr2, between two line searches; 0 where a row is slack
    float* const force;      // -ds/dr
    int* const contact_of;   // of a row with a cone, or -1, until there are forces
    float* const efc_D;
    float* const bounds;
    // Of each row its kind, 16 times the rows of its cone, 256 times its limb, and 4096 times its place in the cone.
    unsigned short* const kinds;
    short* const units;   // with cones: the rows whose cost is measured
    float* const cones;
    short* const listed;  // with tiles (part 5): the rows, limb by limb

    float* const limb_blocks;  // H_k by rows, then L_k with the inverse of its diagonal (part 4)
    float* const limb_arms;    // A_k', then Z_k', by columns
    float* const trunk;        // T by rows, up to the diagonal

    CUDA_CALLABLE explicit SharedMemory(float* memory)
        : mass(memory)
        , near(mass + NV * STRIDE)
        , columns(near + ROWS_IN_SHARED * NARROW)
        , spread(columns + WORKSPACE)
        , shared(spread + SPREAD)
        , residual(shared + STRIDE)
        , rate(residual + PADDED_ROWS)
        , stiffness(rate)
        , force(rate + PADDED_ROWS)
        , contact_of((int*)force)
        , efc_D(force + PADDED_ROWS)
        , bounds(efc_D + PADDED_ROWS)
        , kinds((unsigned short*)(bounds + BOUNDS))
        , units((short*)kinds + PADDED_ROWS)
        , cones((float*)(units + PADDED_ROWS))
        , listed((short*)(memory + FLOATS) - PADDED_ROWS)
        , limb_blocks(columns)
        , limb_arms(limb_blocks + LIMBS * LIMB * LIMB_STRIDE)
        , trunk(limb_arms + LIMBS * ARMS * LIMB_STRIDE)
    {
    }
};

// What a lane has of the vectors of the degrees of freedom, and of the Hessian. These are references to arrays that stand
// alone: as members of one struct all of them would leave the registers where the compiler loses track of one.
struct Registers {
    float (&qacc)[BLOCKS];
    float (&M_qacc)[BLOCKS];
    float (&M_search)[BLOCKS];
    float (&qfrc_smooth)[BLOCKS];
    float (&qfrc_constraint)[BLOCKS];
    // The gradient, then y of L y = gradient, then the search direction stand in one place.
    float (&gradient)[BLOCKS];
    float (&search)[BLOCKS];
    float (&inverse_pivot)[BLOCKS];
    float (&hessian)[BLOCKS][NV];
    int (&limbs)[BLOCKS];   // the limb of each, -1 in the trunk
    int (&places)[BLOCKS];  // its place in a row
    float (&own_row)[BLOCKS][NARROW];  // the trunk's entries of the Hessian's row, then the limb's (part 4)
    float (&rest)[ENTRIES];
};

// The constraints of a world while they are solved, as one of its lanes sees them.
struct Solve : SharedMemory, Registers {
    const Arguments& a;
    const World world;
    const int lane, rows, equalities, frictions;
    float* const bound;  // most dry friction, mu of a cone's head, friction of its tangents
    int num_units;
    const float impratio, tolerance, ls_tolerance;
    int* const states;
    // Whether no row touches two limbs; how wide rows are, how many lie in shared memory, and where the others are.
    bool by_limbs = false;
    int width = STRIDE, near_rows = 0;
    float* far = nullptr;
    int tile_begin = 0, tile_end = 0;    // where the rows of a lane's tile are listed (part 5)
    int tile_slot = 0, tile_length = 0;  // the slots of its limb

    CUDA_CALLABLE Solve(const Arguments& a, const World& world, float* memory, const Registers& registers)
        : SharedMemory(memory)
        , Registers(registers)
        , a(a)
        , world(world)
        , lane(world.lane)
        , rows(wp::min(a.nefc.data[world.world], NJ))
        , equalities(wp::min(a.ne.data[world.world], rows))
        , frictions(a.nf.data[world.world])
        , bound(bounds - equalities)
        , num_units(ELLIPTIC ? 0 : rows - equalities)
        , impratio(world.of_world(a.impratio_invsqrt))
        , tolerance(world.of_world(a.tolerance))
        , ls_tolerance(world.of_world(a.ls_tolerance))
        , states(world.row_of(a.efc_state))
    {
    }

    template <class T>
    CUDA_CALLABLE T* row_of(const wp::array_t<T>& array) const
    {
        return world.row_of(array);
    }

    // A debug build notes which invariants do not hold; any other one compiles to nothing here.
    CUDA_CALLABLE void require(bool holds, int invariant) const
    {
        if (!CHECKED || holds)
            return;
#if defined(__CUDA_ARCH__)
        atomicOr(a.broken.data + world.world, invariant);
#else
        a.broken.data[world.world] |= invariant;
#endif
    }

    // A lane beyond the last degree of freedom does what the lane of the last one does, and writes nothing.
    CUDA_CALLABLE bool is_dof(int block) const
    {
        return block * LANES + lane < NV;
    }

    CUDA_CALLABLE int slot_of(int block) const
    {
        return wp::min(block * LANES + lane, NV - 1);
    }

    CUDA_CALLABLE int dof_of(int block) const
    {
        return a.dofs.data[slot_of(block)];
    }

    // MuJoCo orders rows as equalities, dry friction, limits and contacts (computation chapter, "Constraint model").
    CUDA_CALLABLE int kind_by_order(int row) const
    {
        return row < equalities ? EQUALITY : row < equalities + frictions ? FRICTION : ONE_SIDED;
    }

    CUDA_CALLABLE int kind_of(int row) const
    {
        return ELLIPTIC ? kinds[row] & 15 : kind_by_order(row);
    }

    CUDA_CALLABLE int cone_size(int row) const
    {
        return kinds[row] >> 4 & 15;
    }

    CUDA_CALLABLE int limb_of(int row) const
    {
        return kinds[row] >> 8 & 15;
    }

    CUDA_CALLABLE int head_of(int row) const
    {
        return row - (kinds[row] >> 12);
    }

    // The units of which a cost is measured are all rows but equalities and tangents.
    CUDA_CALLABLE int unit_of(int unit) const
    {
        return ELLIPTIC ? units[unit] : equalities + unit;
    }

    CUDA_CALLABLE bool touches(int block, int limb) const
    {
        return limbs[block] < 0 || limbs[block] == limb;
    }

    CUDA_CALLABLE float* jacobian_of(int row) const
    {
        return (row < near_rows ? near : far) + row * width;
    }

    // Calls body(row, its J) for the rows first, first + stride, ...: those in shared memory, so many in one go, then
    // those that found no room there.
    template <int AT_ONCE, class Body>
    CUDA_CALLABLE void each_row(int first, int stride, Body body) const
    {
#pragma unroll AT_ONCE
        for (int row = first; row < near_rows; row += stride)
            body(row, near + row * width);
        if (HAS_FAR_ROWS)
#pragma unroll 1
            for (int row = near_rows + first; row < rows; row += stride)
                body(row, far + row * width);
    }
};

// Finds the limb of each row and the contact of each row of a cone, and with these how wide rows are.
CUDA_CALLABLE inline void measure_rows(Solve& s)
{
    const Arguments& a = s.a;
    bool couples = false;
#pragma unroll 1
    for (int row = s.lane; row < s.rows; row += LANES) {
        const int begin = s.row_of(a.efc_J_rowadr)[row], end = begin + s.row_of(a.efc_J_rownnz)[row];
        int limb = -1;
#pragma unroll 4
        for (int entry = begin; entry < end; ++entry) {
            const int other = a.limbs.data[s.row_of(a.efc_J_colind)[entry]];
            couples |= limb >= 0 && other >= 0 && other != limb;
            limb = wp::max(limb, other);
        }
        s.kinds[row] = wp::max(limb, 0) << 8;
        if (ELLIPTIC)
            s.contact_of[row] = s.row_of(a.efc_type)[row] == ELLIPTIC_CONTACT ? s.row_of(a.efc_id)[row] : -1;
    }
    s.by_limbs = LIMBS > 0 && lanes_where(couples) == 0;
    s.width = s.by_limbs ? NARROW : STRIDE;
    s.near_rows = wp::min(s.rows, ROWS_IN_SHARED * NARROW / s.width);
    s.far = s.row_of(a.scratch) - s.near_rows * s.width;
}

}
