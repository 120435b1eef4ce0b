// What follows from the joint-space inertia M at `qpos0` in one world: inverse weights, and accelerations of actuators.
//
// M = L^T D L is eliminated from the leaves to the root (Featherstone, "Rigid Body Dynamics Algorithms", 2008, section
// 6.5), which leaves L^-1 above the diagonal (transposed), and D on it. Then J M^-1 J^T = sum_k (J L^-1)_k^2 / D_k for each
// Jacobian row, sums of squares that nothing cancels in.
//
// Few worlds reset at a time, so that what counts is how long one takes: its lanes, a block on a GPU, share each stage,
// and what they work on lies in shared memory where it fits. All of them reach each `wait`.
#pragma once
#include "ksim_rl/device/lanes.cuh"

namespace constants_of_inertia {

namespace given {
constexpr int NV = 14;          // degrees of freedom
constexpr int NB = 10;          // bodies
constexpr int FLOATS = 788;     // of a world, see `Memory`
constexpr int IN_SHARED = 1;      // whether these are in shared memory, or else in the scratch
}

using namespace given;
using namespace lanes;
using vec3 = wp::vec3;
using mat33 = wp::mat33;

constexpr int WIDTH = NV > 0 ? NV : 1;
constexpr int COLUMNS = LANES < 32 ? LANES : 32, ROWS = LANES / COLUMNS;

struct Arguments {
    wp::array_t<float> scratch;
    wp::array_t<vec3> axis;    // of each degree of freedom, in the axes of the world
    wp::array_t<vec3> anchor;
    wp::array_t<float> dof_rotates;  // 1 or 0
    wp::array_t<int> dof_parentid;
    wp::array_t<vec3> xipos;
    wp::array_t<mat33> inertia;  // of a body about its centre of mass, in the axes of the world
    wp::array_t<float> body_mass;
    wp::array_t<int> last_dof;  // that moves a body
    wp::array_t<int> body_subtreenum;
    wp::array_t<int> dof_bodyid;
    wp::array_t<float> dof_armature;
    int num_actuators;  // with armature
    wp::array_t<int> actuator_dof;
    wp::array_t<wp::vec_t<6, float>> actuator_gear;
    wp::array_t<float> actuator_armature;
    wp::array_t<bool> slides_alone;
    wp::array_t<wp::vec2> body_invweight0;
    wp::array_t<int> group_start;  // the first degree of freedom of the same joint and kind
    wp::array_t<int> group_size;
    wp::array_t<float> dof_invweight0;
    wp::array_t<float> actuator_acc0;
};

// Waits until all lanes of a world have written: they are a block.
CUDA_CALLABLE inline void wait()
{
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
}

// What the lanes of a world work on.
struct Memory {
    float* factor;   // M, then its factor
    float* inverse;  // of M
    vec3* axes;
    vec3* anchors;
    float* rotates;
    float* reciprocals;  // of D
    int* parents;
    vec3* points;     // centres of mass
    vec3* moments;    // mass of a subtree times its offset from the centre of mass of its first body
    mat33* inertias;
    mat33* spreads;   // inertia of a subtree about the centre of mass of its first body
    float* masses;
    float* totals;    // mass of a subtree
    int* tips;        // the last dof that moves a body

    CUDA_CALLABLE explicit Memory(float* begin)
        : factor(begin)
        , inverse(factor + NV * NV)
        , axes((vec3*)(inverse + NV * NV))
        , anchors(axes + NV)
        , rotates((float*)(anchors + NV))
        , reciprocals(rotates + NV)
        , parents((int*)(reciprocals + NV))
        , points((vec3*)(parents + NV))
        , moments(points + NB)
        , inertias((mat33*)(moments + NB))
        , spreads(inertias + NB)
        , masses((float*)(spreads + NB))
        , totals(masses + NB)
        , tips((int*)(totals + NB))
    {
    }

    // Velocity of a point when its dof moves at unit speed.
    CUDA_CALLABLE vec3 velocity_of(int dof, const vec3& point) const
    {
        return rotates[dof] * wp::cross(axes[dof], point - anchors[dof]) + (1.0f - rotates[dof]) * axes[dof];
    }

    // An entry of L^-1.
    CUDA_CALLABLE float share_of(int k, int dof) const
    {
        return dof == k ? 1.0f : factor[k * NV + dof];
    }
};

// Reads a world.
CUDA_CALLABLE inline void load(const World& world, const Memory& m, const Arguments& a)
{
    world.share(NV, [&](int dof) {
        m.axes[dof] = world.model_row(a.axis)[dof];
        m.anchors[dof] = world.model_row(a.anchor)[dof];
        m.rotates[dof] = a.dof_rotates.data[dof];
        m.parents[dof] = a.dof_parentid.data[dof];
    });
    world.share(NB, [&](int body) {
        m.points[body] = world.model_row(a.xipos)[body];
        m.inertias[body] = world.model_row(a.inertia)[body];
        m.masses[body] = world.model_row(a.body_mass)[body];
        m.tips[body] = a.last_dof.data[body];
    });
    world.share(NV * NV, [&](int place) { m.factor[place] = 0.0f; });
}

// Mass, first moment and inertia of each subtree.
CUDA_CALLABLE inline void sum_subtrees(const World& world, const Memory& m, const Arguments& a)
{
    world.share(NB - 1, [&](int item) {
        const int first = item + 1, end = first + a.body_subtreenum.data[first];
        const vec3 point = m.points[first];
        float total = 0.0f;
        vec3 moment;
        mat33 spread;
        for (int body = first; body < end; ++body) {
            const vec3 offset = m.points[body] - point, part = m.masses[body] * offset;
            const float square = wp::dot(offset, part);
            total += m.masses[body];
            moment = moment + part;
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j)
                    spread.data[i][j] += m.inertias[body].data[i][j] - offset[i] * part[j] + (i == j ? square : 0.0f);
        }
        m.totals[first] = total;
        m.moments[first] = moment;
        m.spreads[first] = spread;
    });
}

// A row of M is what the momentum of a dof's subtree, moved at unit speed, is along the dofs of its chain.
CUDA_CALLABLE inline void fill_inertia(const World& world, const Memory& m, const Arguments& a)
{
    world.share(NV, [&](int dof) {
        const int first = a.dof_bodyid.data[dof];
        const vec3 point = m.points[first], turning = m.rotates[dof] * m.axes[dof], velocity = m.velocity_of(dof, point);
        const vec3 momentum = m.totals[first] * velocity + wp::cross(turning, m.moments[first]);
        const vec3 spin = wp::mul(m.spreads[first], turning) + wp::cross(m.moments[first], velocity);
        float armature = world.model_row(a.dof_armature)[dof];
        for (int i = 0; i < a.num_actuators; ++i)
            if (a.actuator_dof.data[i] == dof) {
                const float gear = world.model_row(a.actuator_gear)[i][0];
                armature += world.model_row(a.actuator_armature)[i] * gear * gear;
            }
        for (int other = dof; other >= 0; other = m.parents[other]) {
            const float along = wp::dot(momentum, m.velocity_of(other, point)) + m.rotates[other] * wp::dot(spin, m.axes[other]);
            m.factor[dof * NV + other] = m.factor[other * NV + dof] = along + (other == dof ? armature : 0.0f);
        }
    });
}

// Step k changes the rows above row k, of which each lane has some columns, and reads row k alone beside them.
CUDA_CALLABLE inline void eliminate(const World& world, const Memory& m)
{
    for (int k = NV - 1; k >= 0; --k) {
        const float* __restrict__ const pivot = m.factor + k * NV;
        const float reciprocal = 1.0f / pivot[k];
        if (world.lane == 0)
            m.reciprocals[k] = reciprocal;
        for (int j = world.lane % COLUMNS; j < NV; j += COLUMNS) {
            const float scaled = (j == k ? 1.0f : pivot[j]) * reciprocal;
            if (scaled == 0.0f)
                continue;
#pragma unroll 4
            for (int i = world.lane / COLUMNS; i < k; i += ROWS)
                m.factor[i * NV + j] = (j == k ? 0.0f : m.factor[i * NV + j]) - pivot[i] * scaled;
        }
        wait();
    }
}

// M^-1.
CUDA_CALLABLE inline void invert(const World& world, const Memory& m)
{
    world.share(NV * NV, [&](int place) {
        const int i = place / WIDTH, j = place % WIDTH, last = wp::min(i, j);
        float total = 0.0f;
        for (int k = last; k >= 0; k = m.parents[k])
            total += m.share_of(k, i) * m.share_of(k, j) * m.reciprocals[k];
        m.inverse[place] = total;
    });
}

// Mean diagonal of J M^-1 J^T at each centre of mass: translation, rotation. As in C, a body that only slides has 0 for
// rotation, where mujoco_warp.set_const takes the other figure; and one that C calls simple, which slides along axes of
// the world and carries nothing, weighs what its mass does, whatever its armature.
CUDA_CALLABLE inline void weigh_bodies(const World& world, const Memory& m, const Arguments& a)
{
    world.share(NB, [&](int body) {
        if (a.slides_alone.data[body]) {
            world.model_row(a.body_invweight0)[body] = wp::vec2(1.0f / m.masses[body], 0.0f);
            return;
        }
        const vec3 point = m.points[body];
        float moved = 0.0f, turned = 0.0f;
        for (int k = m.tips[body]; k >= 0; k = m.parents[k]) {
            vec3 linear, angular;
            for (int i = m.tips[body]; i >= k; i = m.parents[i]) {
                const float share = m.share_of(k, i);
                linear = linear + share * m.velocity_of(i, point);
                angular = angular + share * m.rotates[i] * m.axes[i];
            }
            moved += wp::dot(linear, linear) * m.reciprocals[k];
            turned += wp::dot(angular, angular) * m.reciprocals[k];
        }
        world.model_row(a.body_invweight0)[body] = wp::vec2(moved / 3.0f, turned / 3.0f);
    });
}

// Diagonal of M^-1, averaged over the translations and over the rotations of one joint.
CUDA_CALLABLE inline void weigh_dofs(const World& world, const Memory& m, const Arguments& a)
{
    world.share(NV, [&](int dof) {
        const int first = a.group_start.data[dof], size = a.group_size.data[dof];
        float total = 0.0f;
        for (int member = first; member < first + size; ++member)
            total += m.inverse[member * NV + member];
        const int body = a.dof_bodyid.data[dof];
        world.model_row(a.dof_invweight0)[dof] = a.slides_alone.data[body] ? 1.0f / m.masses[body] : total / (float)size;
    });
}

// Norm of the acceleration from unit force: of a column of M^-1, times the gear.
CUDA_CALLABLE inline void accelerate_actuators(const World& world, const Memory& m, const Arguments& a)
{
    world.share(a.actuator_dof.shape[0], [&](int actuator) {
        const float* const column = m.inverse + a.actuator_dof.data[actuator] * NV;
        float total = 0.0f;
#pragma unroll 4
        for (int dof = 0; dof < NV; ++dof)
            total += column[dof] * column[dof];
        world.model_row(a.actuator_acc0)[actuator] = wp::abs(world.model_row(a.actuator_gear)[actuator][0]) * wp::sqrt(total);
    });
}

CUDA_CALLABLE inline void run(int index, int lane, const Arguments& a)
{
    float* begin = a.scratch.data + (size_t)index * FLOATS;
#if defined(__CUDA_ARCH__)
    __shared__ float in_shared[IN_SHARED ? FLOATS : 1];
    begin = IN_SHARED ? in_shared : begin;
#endif
    const World world {index, lane};
    const Memory m(begin);
    load(world, m, a);
    wait();
    sum_subtrees(world, m, a);
    wait();
    fill_inertia(world, m, a);
    wait();
    eliminate(world, m);
    invert(world, m);
    weigh_bodies(world, m, a);
    wait();
    weigh_dofs(world, m, a);
    accelerate_actuators(world, m, a);
}

}
