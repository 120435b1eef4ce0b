// The collision pass of one world: our contacts, and the pairs for MuJoCo Warp's narrow phase. Read the parts in their
// order: broad_phase.cuh, shapes.cuh, narrow_phase.cuh.
#pragma once
#include "ksim_rl/physics/collision/narrow_phase.cuh"

namespace collisions {

constexpr int BITS = 16, CHUNK = BITS * LANES;  // so many pairs are listed in one go

// Hands a pair over whose contacts we do not find.
CUDA_CALLABLE inline void hand_over(const Geoms& geoms, int pair, bool is_theirs)
{
    const Arguments& a = geoms.a;
    const Count lanes = lanes_with(geoms.world.lane, is_theirs);
    const int place = lanes.all > 0 ? take(geoms.world.lane, a.ncollision.data, lanes.all) + lanes.before : 0;
    if (is_theirs && place < a.naconmax) {
        a.collision_pair.data[place] = wp::vec2i(geoms.pairs[pair][0], geoms.pairs[pair][1]);
        a.collision_pairid.data[place] = geoms.pair_ids[pair];
        a.collision_worldid.data[place] = geoms.world.world;
    }
}

// Finds the contacts of pairs that are near each other, of which a lane has one at a time.
CUDA_CALLABLE inline void find_contacts(
    const Geoms& geoms, int begin, int count, const unsigned short* near, Contacts& contacts
)
{
    for (int item = geoms.world.lane; item - geoms.world.lane < count; item += LANES) {
        const int pair = begin + near[wp::min(item, count - 1)];
        const int one = geoms.pairs[pair][0], other = geoms.pairs[pair][1];
        const float margin = geoms.margin_of(pair);
        int most = item < count ? geoms.pairs[pair][2] : 0;
        if (OTHERS)
            hand_over(geoms, pair, item < count && most == 0 && geoms.may_touch(pair));
        if (most > 0 && geoms.a.geom_type.data[other] == BOX && !geoms.may_touch(pair))
            most = 0;
        for (int which = 0; lanes_with(geoms.world.lane, which < most).all > 0; ++which) {
            Touch touch;
            if (which < most)
                touch = touch_of(geoms, one, other, which);
            contacts.add(geoms, touch, touch.distance < margin, pair, which);
        }
    }
    sync();
}

CUDA_CALLABLE inline void run(int index, int lane, const Arguments& a)
{
#if defined(__CUDA_ARCH__)
    __shared__ unsigned short all_near[THREADS / LANES][CHUNK];
    __shared__ __align__(16) char all_contacts[THREADS / LANES][ROOM * sizeof(Found)];
    unsigned short* const near = all_near[threadIdx.x / LANES];
    Found* const found = (Found*)all_contacts[threadIdx.x / LANES];
#else
    unsigned short near[CHUNK];
    Found found[ROOM];
#endif
    const World world = world_of(index, lane);
    const Geoms geoms(a, world);
    Contacts contacts {found};
    const int num_pairs = a.pairs.shape[0];
    for (int begin = 0; begin < num_pairs; begin += CHUNK) {
        // Few pairs are near each other: they are listed first, so that no lane waits for another's.
        const int size = wp::min(CHUNK, num_pairs - begin);
        int count = 0;
#pragma unroll HAS_MARGINS ? 1 : 2  // as the compiler does by itself, if it sees all in one function
        for (int item = lane; item - lane < size; item += LANES) {
            const bool passes = item < size && geoms.are_near(begin + item);
            const Count lanes = lanes_with(lane, passes);
            if (passes)
                near[count + lanes.before] = item;
            count += lanes.all;
        }
        sync();
        find_contacts(geoms, begin, count, near, contacts);
    }
    contacts.flush(geoms);
    if (lane == 0 && a.lists)
        a.appended.data[index] = contacts.listed;
}

}
