// What contact sensors read that a body's geoms name, and accelerometers; a lane reads a sensor.
#pragma once
#include "ksim_rl/physics/rows/matching.cuh"
#include "ksim_rl/physics/rows/wrench.cuh"

namespace contact_readings {

namespace given {
constexpr int NUM_DOFS = 14;
constexpr int SENSORS = 4;         // of contacts; the others of the list are accelerometers
constexpr int ACCELEROMETERS = 1;
constexpr int GRAVITY = 1;         // whether there is any
constexpr int SUM = 3;             // the reduction that sums forces
}

using namespace given;
using namespace contacts;

struct Arguments : WrenchArguments, MatchArguments {
    wp::array_t<int> ids;
    wp::array_t<int> count;
    wp::array_t<int> sensors;
    wp::array_t<int> sensor_objtype;
    wp::array_t<int> sensor_objid;
    wp::array_t<int> sensor_reftype;
    wp::array_t<int> sensor_refid;
    wp::array_t<int> sensor_intprm;
    wp::array_t<wp::vec2i> contact_geom;
    wp::array_t<wp::vec3> contact_pos;
    wp::array_t<float> sensordata;
    wp::array_t<int> sensor_adr;
    bool accelerates;
    wp::array_t<int> site_bodyid;
    wp::array_t<int> body_isdofancestor;
    wp::array_t<wp::vec3> gravity;
    wp::array_t<wp::vec_t<6, float>> cdof_dot;
    wp::array_t<float> qvel;
    wp::array_t<wp::vec_t<6, float>> cdof;
    wp::array_t<float> qacc;
    wp::array_t<wp::vec_t<6, float>> cvel;
    wp::array_t<wp::mat33> site_xmat;
    wp::array_t<wp::vec3> site_xpos;
    wp::array_t<wp::vec3> subtree_com;
    wp::array_t<int> body_rootid;
};

CUDA_CALLABLE inline vec3 vector_of_lane(const vec3& v, int source)
{
    return vec3(of_lane(v[0], source), of_lane(v[1], source), of_lane(v[2], source));
}

// Of equally strong contacts the first of the list counts, as in the C engine. Each lane reads one of the next contacts and
// passes it on to all, each of which asks whether its sensor matches it: a contact lies anywhere in the pool, and what to
// read of it follows from what is read before.
CUDA_CALLABLE inline void read_contacts(const World& world, const Arguments& a)
{
    const int* const listed = world.row_of(a.ids);
    const int contacts = a.count.data[world.world];
#pragma unroll 1
    for (int place = world.lane; place - world.lane < SENSORS; place += LANES) {
        const int sensor = a.sensors.data[wp::min(place, SENSORS - 1)];
        const int kind = a.sensor_objtype.data[sensor], element = a.sensor_objid.data[sensor];
        const int other_kind = a.sensor_reftype.data[sensor], other = a.sensor_refid.data[sensor];
        const bool is_net = a.sensor_intprm.data[sensor * a.sensor_intprm.shape[1] + 1] == SUM;
        int found = 0, strongest = -1;
        float size = 0.0f, most = -1.0f, sign = 1.0f;
        vec3 force(0.0f), position(0.0f);
#pragma unroll 1
        for (int first = 0; first < contacts; first += LANES) {
            int read = 0, geom_read = 0, other_read = 0;
            vec3 force_read(0.0f), turned_read(0.0f), position_read(0.0f);
            if (first + world.lane < contacts) {
                read = listed[first + world.lane];
                geom_read = a.contact_geom.data[read][0];
                other_read = a.contact_geom.data[read][1];
                force_read = wrench_of(world, a, read).force;
                turned_read = in_world(a, read, force_read);
                position_read = a.contact_pos.data[read];
            }
#pragma unroll 1
            for (int source = 0; source < wp::min(LANES, contacts - first); ++source) {
                const int contact = of_lane(read, source);
                const int geom = of_lane(geom_read, source), other_geom = of_lane(other_read, source);
                const vec3 own_force = vector_of_lane(force_read, source), turned = vector_of_lane(turned_read, source);
                const vec3 at = vector_of_lane(position_read, source);
                // In the direction of the contact, or against it.
                const bool along = is_of(a, geom, kind, element) && is_of(a, other_geom, other_kind, other);
                if (!along && !(is_of(a, other_geom, kind, element) && is_of(a, geom, other_kind, other)))
                    continue;
                ++found;
                const float own_size = wp::dot(own_force, own_force), own_sign = along ? 1.0f : -1.0f;
                if (is_net) {
                    const float weight = sqrtf(own_size);
                    size += weight;
                    position += weight * at;
                    force += own_sign * turned;
                } else if (own_size > most) {
                    // The axes of the contact are turned with it, all but the second tangent.
                    most = own_size, sign = own_sign, strongest = contact;
                    force = vec3(own_force[0], own_force[1], sign * own_force[2]);
                    position = at;
                }
            }
        }
        if (place >= SENSORS || !found)
            continue;
        if (is_net)
            position = position / wp::max(size, 1e-15f);
        float* const out = world.row_of(a.sensordata) + a.sensor_adr.data[sensor];
        out[0] = (float)found;
        for (int axis = 0; axis < 3; ++axis) {
            out[1 + axis] = force[axis];
            out[4 + axis] = position[axis];
            if (strongest >= 0)
                for (int of_contact = 0; of_contact < 2; ++of_contact)
                    out[7 + 3 * of_contact + axis] = sign * axis_of(a, strongest, of_contact)[axis];
        }
    }
}

// The acceleration of their body (mj_rnePostConstraint), summed from its root on, at their place.
CUDA_CALLABLE inline void read_accelerometers(const World& world, const Arguments& a)
{
    world.each(a.accelerates ? ACCELEROMETERS : 0, [&](int place) {
        const int sensor = a.sensors.data[SENSORS + place], site = a.sensor_objid.data[sensor];
        const int body = a.site_bodyid.data[site];
        const int* const moves = a.body_isdofancestor.data + (size_t)body * a.body_isdofancestor.shape[1];
        wp::vec_t<6, float> rising(0.0f);
        for (int axis = 0; axis < 3; ++axis)
            rising[3 + axis] = GRAVITY ? -a.gravity.data[a.gravity.shape[0] > 1 ? world.world : 0][axis] : 0.0f;
        // All are read, also those that do not move it, so that several are on their way at once.
#pragma unroll 5
        for (int dof = 0; dof < NUM_DOFS; ++dof) {
            const auto carried = rising + world.row_of(a.cdof_dot)[dof] * world.row_of(a.qvel)[dof];
            const auto moved = carried + world.row_of(a.cdof)[dof] * world.row_of(a.qacc)[dof];
            rising = moves[dof] ? moved : rising;
        }
        const auto& moving = world.row_of(a.cvel)[body];
        const wp::mat33 back = wp::transpose(world.row_of(a.site_xmat)[site]);
        const vec3 arm = world.row_of(a.site_xpos)[site] - world.row_of(a.subtree_com)[a.body_rootid.data[body]];
        auto at_site = [&](const auto& v) {
            return wp::mul(back, vec3(v[3], v[4], v[5]) - wp::cross(arm, vec3(v[0], v[1], v[2])));
        };
        const vec3 spin = wp::mul(back, vec3(moving[0], moving[1], moving[2]));
        const vec3 read = at_site(rising) + wp::cross(spin, at_site(moving));
        for (int axis = 0; axis < 3; ++axis)
            world.row_of(a.sensordata)[a.sensor_adr.data[sensor] + axis] = read[axis];
    });
}

CUDA_CALLABLE inline void run(int index, int lane, const Arguments& a)
{
    const World world = world_of(index, lane);
    read_contacts(world, a);
    read_accelerometers(world, a);
}

}
