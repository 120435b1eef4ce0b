// What makes a row: its place, and the law of the spring and damper that it is.
//
// A row has the distance `position` of what it holds off its bound, J, and the velocity J qvel. Its reference is
// the acceleration aref = -b (J qvel) - k d(position) position, and D is the inverse of its regularization
// (1 - d) / d times its inverse inertia, with the impedance d in (0, 1) ("Constraint model: Parameters").
#pragma once
#include "ksim_rl/physics/rows/arguments.cuh"

namespace constraint_rows {

constexpr float TINY = 1e-15f, LEAST_IMPEDANCE = 1e-4f, MOST_IMPEDANCE = 0.9999f, PI = 3.14159265f;

struct Law {
    float stiffness, damping, impedance;
};

CUDA_CALLABLE inline Law law_of(
    const wp::vec2& solref, const wp::vec_t<5, float>& solimp, float position, float timestep
)
{
    const float time = REFSAFE ? wp::max(solref[0], 2.0f * timestep) : solref[0], ratio = solref[1];
    const float least = wp::clamp(solimp[0], LEAST_IMPEDANCE, MOST_IMPEDANCE);
    const float most = wp::clamp(solimp[1], LEAST_IMPEDANCE, MOST_IMPEDANCE);
    const float middle = wp::clamp(solimp[3], LEAST_IMPEDANCE, MOST_IMPEDANCE);
    const float power = wp::max(1.0f, solimp[4]), part = wp::abs(position) / wp::max(TINY, solimp[2]);
    Law law;
    // A reference that is not positive gives stiffness and damping directly.
    law.stiffness = solref[0] <= 0.0f ? -solref[0] / wp::max(TINY, most * most)
                                      : 1.0f / wp::max(TINY, most * most * time * time * ratio * ratio);
    law.damping = ratio <= 0.0f ? -ratio / wp::max(TINY, most) : 2.0f / wp::max(TINY, most * time);
    if (least == most || solimp[2] <= TINY)
        law.impedance = 0.5f * (least + most);
    else if (part <= 0.0f)
        law.impedance = least;
    else if (part >= 1.0f)
        law.impedance = most;
    else if (power == 1.0f)
        law.impedance = least + part * (most - least);
    else {
        const bool is_upper = part > middle;
        const float x = is_upper ? 1.0f - part : part, at = is_upper ? 1.0f - middle : middle;
        // As in C; a power of two, the usual one, needs no logarithms.
        const float curved = power == 2.0f ? x * x / at : wp::pow(x, power) / wp::pow(at, power - 1.0f);
        const float rise = is_upper ? 1.0f - curved : curved;
        law.impedance = wp::clamp(least + rise * (most - least), least, most);
    }
    return law;
}

struct Row {
    int type, owner;  // the equality, degree of freedom, joint or contact that it belongs to
    float position, margin, velocity, invweight, frictionloss, softness;  // softness divides D
};

struct Place {
    int row, address, rows;  // the first row, where its nonzeros begin, and how many rows are written
};

// The rows of a world, as one of its lanes makes them.
//
// Rows take their places in turns of all lanes. Those beyond NJMAX are counted, and not written. From the first ones on
// whose nonzeros do not fit, no rows are made, nor counted.
struct Rows {
    const World& world;
    const Arguments& a;
    const float timestep;
    const float* const qpos;
    const float* const qvel;
    float* const jacobian;
    int* const columns;
    int* const owners;
    int asked = 0, made = 0, nonzeros_asked = 0;

    CUDA_CALLABLE Rows(const World& world, const Arguments& a)
        : world(world)
        , a(a)
        , timestep(world.of_world(a.timestep))
        , qpos(world.row_of(a.qpos))
        , qvel(world.row_of(a.qvel))
        , jacobian(world.row_of(a.efc_J))
        , columns(world.row_of(a.efc_J_colind))
        , owners(world.row_of(a.efc_id))
    {
    }

    // Takes places for rows of this lane with as many nonzeros each; all lanes have to come here.
    CUDA_CALLABLE Place reserve(int rows, int nonzeros)
    {
        Place place;
        place.row = asked + sum_before(world.lane, rows);
        place.rows = wp::clamp(NJMAX - place.row, 0, rows);
        const int floats = place.rows * nonzeros;
        place.address = nonzeros_asked + sum_before(world.lane, floats);
        const bool fits = place.address + floats <= MOST_NONZEROS;
        const int fitting = fits ? rows : 0;
        made = of_lane(made + sum_before(world.lane, fitting) + fitting, LANES - 1);
        asked = of_lane(place.row + rows, LANES - 1);
        nonzeros_asked = of_lane(place.address + floats, LANES - 1);
        place.rows = fits ? place.rows : 0;
        return place;
    }

    CUDA_CALLABLE Law law_of(const wp::vec2& solref, const wp::vec_t<5, float>& solimp, float position) const
    {
        return constraint_rows::law_of(solref, solimp, position, timestep);
    }

    CUDA_CALLABLE void write_row(int row, const Row& made, const Law& law) const
    {
        const float regularization = wp::max(made.invweight * (1.0f - law.impedance) / law.impedance, TINY);
        world.row_of(a.efc_type)[row] = made.type;
        owners[row] = made.owner;
        world.row_of(a.efc_pos)[row] = made.position + made.margin;
        world.row_of(a.efc_margin)[row] = made.margin;
        world.row_of(a.efc_vel)[row] = made.velocity;
        world.row_of(a.efc_D)[row] = 1.0f / regularization / made.softness;
        world.row_of(a.efc_aref)[row] = -law.stiffness * law.impedance * made.position - law.damping * made.velocity;
        world.row_of(a.efc_frictionloss)[row] = made.frictionloss;
    }

    CUDA_CALLABLE void write_nonzero(int address, int dof, float value) const
    {
        columns[address] = dof;
        jacobian[address] = value;
    }
};

// Calls body(item, whether there is one) in all lanes of a world together.
template <class Body>
CUDA_CALLABLE inline void in_turns(const World& world, int count, Body body)
{
#pragma unroll 1
    for (int first = 0; first < count; first += LANES)
        body(first + world.lane, first + world.lane < count);
}

}
