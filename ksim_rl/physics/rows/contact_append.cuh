// The first half of the lists where MuJoCo Warp's narrow phase has a part: all threads share out the pool.
#pragma once
#include "ksim_rl/device/lanes.cuh"

namespace contact_append {

namespace given {
constexpr int HAS_ROWS = 1;  // the type of a contact that may have rows
}

using namespace given;
using namespace lanes;

struct Arguments {
    wp::array_t<int> appended;
    wp::array_t<int> found;
    wp::array_t<int> nacon;
    int naconmax;
    wp::array_t<int> contact_type;
    wp::array_t<int> contact_worldid;
};

CUDA_CALLABLE inline void run(int world, int lane, const Arguments& a)
{
    const int worlds = a.appended.shape[0], room = a.found.shape[1];
    const int contacts = wp::min(*a.nacon.data, a.naconmax);
#pragma unroll 1
    for (int contact = world * LANES + lane; contact < contacts; contact += worlds * LANES) {
        if (!(a.contact_type.data[contact] & HAS_ROWS))
            continue;
        const int owner = a.contact_worldid.data[contact];
        const int place = wp::atomic_add(a.appended.data + owner, 1);
        if (place < room)
            a.found.data[owner * room + place] = contact;
    }
}

}
