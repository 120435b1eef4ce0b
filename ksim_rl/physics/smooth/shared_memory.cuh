// Where the numbers of a world lie in shared memory, from where they go to global memory in whole rows: lanes that
// write the fields of a body each on their own would touch every sector of memory once per number.
#pragma once
#include "ksim_rl/physics/smooth/dynamics_arguments.cuh"

namespace smooth_dynamics {

constexpr int UNROLLED_BODIES = NUM_BODIES <= 64 ? NUM_BODIES : 4;
constexpr int POSE = 10;  // floats of a body: position, quaternion and centre of mass, then its inertia
constexpr int STAGED = 6 * (NUM_DOFS + NUM_BODIES);

struct SharedMemory {
    float* poses;
    float* inertias;         // once the poses are written
    float* actuator_forces;  // once the inertias are summed
    float* passive;          // forces, behind these
    float* coms;             // centres of mass of subtrees
    float* joints;           // anchors and axes
    float* velocities;       // of the bodies, once the degrees of freedom have their axes
    float* momenta;          // crb * cdof, once the bodies have their forces
    float* motions;          // cdof
    float* forces;           // accelerations of the bodies under their velocities, then forces
    float* staged;           // until the motions are known, what waits to be written

    CUDA_CALLABLE explicit SharedMemory(float* begin)
        : poses(begin)
        , inertias(poses)
        , actuator_forces(poses)
        , passive(poses + NUM_ACTUATORS)
        , coms(poses + POSES)
        , joints(coms + 3 * NUM_BODIES)
        , velocities(joints)
        , momenta(joints)
        , motions(joints + JOINTS)
        , forces(motions + 6 * NUM_DOFS)
        , staged(motions)
    {
    }

    CUDA_CALLABLE vec3& position(int body) const
    {
        return *(vec3*)(poses + POSE * body);
    }

    CUDA_CALLABLE quat& turn(int body) const
    {
        return *(quat*)(poses + POSE * body + 3);
    }

    CUDA_CALLABLE vec3& center(int body) const
    {
        return *(vec3*)(poses + POSE * body + 7);
    }

    CUDA_CALLABLE inertia10& inertia(int body) const
    {
        return *(inertia10*)(inertias + POSE * body);
    }

    CUDA_CALLABLE vec3& com(int body) const
    {
        return *(vec3*)(coms + 3 * body);
    }

    CUDA_CALLABLE vec3& anchor(int joint) const
    {
        return *(vec3*)(joints + 6 * joint);
    }

    CUDA_CALLABLE vec3& axis(int joint) const
    {
        return *(vec3*)(joints + 6 * joint + 3);
    }

    CUDA_CALLABLE spatial& motion(int dof) const
    {
        return *(spatial*)(motions + 6 * dof);
    }

    CUDA_CALLABLE spatial& velocity(int body) const
    {
        return *(spatial*)(velocities + 6 * body);
    }

    CUDA_CALLABLE spatial& momentum(int dof) const
    {
        return *(spatial*)(momenta + 6 * dof);
    }

    CUDA_CALLABLE spatial& force(int body) const
    {
        return *(spatial*)(forces + 6 * body);
    }

    // By how much a joint turns, or a slide shifts.
    CUDA_CALLABLE quat& turned_by(int joint) const
    {
        return *(quat*)(staged + 4 * joint);
    }
};

// Writes vectors of shared memory, `stride` floats from one to the next, as the first `count` of a row.
template <class T>
CUDA_CALLABLE inline void write(const World& world, const wp::array_t<T>& array, int count, const float* from, int stride)
{
    constexpr int WIDTH = sizeof(*array.data) / sizeof(float);
    float* const to = (float*)world.row_of(array);
#pragma unroll 4
    for (int place = world.lane; place < count * WIDTH; place += LANES)
        to[place] = from[place / WIDTH * stride + place % WIDTH];
}

// Writes compute(item) at place_of(item) of a row, for all items.
template <class T, class PlaceOf, class Compute>
CUDA_CALLABLE inline void compute_row(
    const World& world,
    const SharedMemory& shared,
    const wp::array_t<T>& array,
    int count,
    PlaceOf place_of,
    Compute compute
)
{
    using Value = decltype(compute(0));
    constexpr int WIDTH = sizeof(Value) / sizeof(float), ROOM = STAGED / WIDTH;
    float* const to = (float*)world.row_of(array);
#pragma unroll 1
    for (int first = 0; first < count; first += ROOM) {
        const int items = wp::min(ROOM, count - first);
        world.each(items, [&](int item) { ((Value*)shared.staged)[item] = compute(first + item); });
        sync_warp();
#pragma unroll 4
        for (int place = world.lane; place < items * WIDTH; place += LANES)
            to[place_of(first + place / WIDTH) * WIDTH + place % WIDTH] = shared.staged[place];
        sync_warp();
    }
}

}
