// The force and torque of a contact, once the solver has found what its rows exert.
#pragma once
#include "ksim_rl/device/lanes.cuh"

namespace contacts {

namespace given {
constexpr int NJMAX = 64;    // rows of a world
constexpr int ELLIPTIC = 0;  // whether friction cones are elliptic
}

using namespace given;
using namespace lanes;
using vec3 = wp::vec3;

// What kernels take that ask for the forces of contacts.
struct WrenchArguments {
    wp::array_t<int> contact_efc_address;
    wp::array_t<wp::vec_t<5, float>> contact_friction;
    wp::array_t<float> efc_force;
    wp::array_t<int> contact_dim;
    wp::array_t<float> contact_adhesion;
    wp::array_t<wp::mat33> contact_frame;
};

struct Wrench {
    vec3 force, torque;
};

// What a contact exerts on its second geom, in its own axes: the normal and two tangents ("mj_contactForce").
CUDA_CALLABLE inline Wrench wrench_of(const World& world, const WrenchArguments& a, int contact)
{
    const int* const rows = a.contact_efc_address.data + (size_t)contact * a.contact_efc_address.shape[1];
    const float* const friction = (const float*)(a.contact_friction.data + contact);
    const float* const forces = world.row_of(a.efc_force);
    // Rows beyond the last one that there is room for exert nothing.
    auto of_row = [=](int row) { return row < NJMAX ? forces[row] : 0.0f; };
    float along[6] = {};
    const int dim = rows[0] < 0 ? 0 : a.contact_dim.data[contact];
    if (ELLIPTIC || dim == 1)
        for (int axis = 0; axis < dim; ++axis)
            along[axis] = of_row(rows[axis]);
    else
        for (int axis = 1; axis < dim; ++axis) {
            const float plus = of_row(rows[0] + 2 * axis - 2), minus = of_row(rows[0] + 2 * axis - 1);
            along[0] += plus + minus;
            along[axis] = (plus - minus) * friction[axis - 1];
        }
    if (dim > 0)
        along[0] -= a.contact_adhesion.data[contact];
    return Wrench {vec3(along[0], along[1], along[2]), vec3(along[3], along[4], along[5])};
}

CUDA_CALLABLE inline vec3 axis_of(const WrenchArguments& a, int contact, int axis)
{
    const float* const axes = (const float*)(a.contact_frame.data + contact) + 3 * axis;
    return vec3(axes[0], axes[1], axes[2]);
}

// A vector in the axes of a contact, in the axes of the world.
CUDA_CALLABLE inline vec3 in_world(const WrenchArguments& a, int contact, const vec3& v)
{
    return v[0] * axis_of(a, contact, 0) + v[1] * axis_of(a, contact, 1) + v[2] * axis_of(a, contact, 2);
}

}
