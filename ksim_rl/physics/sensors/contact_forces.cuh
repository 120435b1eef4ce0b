// What the contacts of each body exert on it, in their order, added to what users apply at its center of mass.
#pragma once
#include "ksim_rl/physics/rows/wrench.cuh"

namespace contact_forces {

namespace given {
constexpr int BODIES = 10;
}

using namespace given;
using namespace contacts;

struct Arguments : WrenchArguments {
    wp::array_t<int> ids;
    wp::array_t<int> count;
    wp::array_t<wp::vec_t<6, float>> xfrc_applied;
    wp::array_t<wp::vec2i> contact_geom;
    wp::array_t<int> geom_bodyid;
    wp::array_t<wp::vec3> contact_pos;
    wp::array_t<wp::vec3> xipos;
    wp::array_t<wp::vec_t<6, float>> forces;
};

CUDA_CALLABLE inline void run(int index, int lane, const Arguments& a)
{
    const World world = world_of(index, lane);
    const int* const listed = world.row_of(a.ids);
    const int contacts = a.count.data[index];
    world.each(BODIES, [&](int body) {
        auto total = world.row_of(a.xfrc_applied)[body];
        for (int i = 0; i < contacts; ++i) {
            const int contact = listed[i];
            const auto& geoms = a.contact_geom.data[contact];
            const int sign = (a.geom_bodyid.data[geoms[1]] == body) - (a.geom_bodyid.data[geoms[0]] == body);
            if (!sign)
                continue;
            const Wrench wrench = wrench_of(world, a, contact);
            const vec3 force = (float)sign * in_world(a, contact, wrench.force);
            const vec3 arm = a.contact_pos.data[contact] - world.row_of(a.xipos)[body];
            const vec3 torque = (float)sign * in_world(a, contact, wrench.torque) + wp::cross(arm, force);
            for (int axis = 0; axis < 3; ++axis) {
                total[axis] += force[axis];
                total[3 + axis] += torque[axis];
            }
        }
        world.row_of(a.forces)[body] = total;
    });
}

}
