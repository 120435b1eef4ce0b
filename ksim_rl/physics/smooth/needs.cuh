// The overflow bits of each world and the most that it needed in this period; the first world has the pool's.
//
// Bits are set from the counts here too: the integration sets them at the end of a substep, and one that evaluates the
// forces several times on its way has made rows that it does not count.
#pragma once
#include "ksim_rl/device/lanes.cuh"

namespace needs {

namespace given {
// Bits of overflow.
constexpr int OUT_OF_ROWS = 1;
constexpr int OUT_OF_PAIRS = 4;
constexpr int OUT_OF_CONTACTS = 8;
}

using namespace given;

// What kernels take that note overflow.
struct NeedsArguments {
    wp::array_t<int> nefc;
    wp::array_t<int> nacon;
    wp::array_t<int> ncollision;
    int njmax;
    int naconmax;
    wp::array_t<int> overflow;
    wp::array_t<int> sticky;
    wp::array_t<int> most_nefc;
    wp::array_t<int> most_pool;
};

// Which of the rows, pairs and contacts of a world found no room, as bits.
CUDA_CALLABLE inline int lacking(int world, const NeedsArguments& a)
{
    const bool lacks_rows = a.nefc.data[world] > a.njmax;
    const bool lacks_pairs = a.ncollision.data[0] > a.naconmax;
    const bool lacks_contacts = a.nacon.data[0] > a.naconmax;
    return (lacks_rows ? OUT_OF_ROWS : 0) | (lacks_pairs ? OUT_OF_PAIRS : 0) | (lacks_contacts ? OUT_OF_CONTACTS : 0);
}

CUDA_CALLABLE inline void raise_to(int& most, int needed)
{
    most = wp::max(most, needed);
}

CUDA_CALLABLE inline void keep_needs(int world, const NeedsArguments& a)
{
    const int rows = a.nefc.data[world];
    const int contacts = *a.nacon.data;
    const int pairs = *a.ncollision.data;
    a.sticky.data[world] |= a.overflow.data[world] | lacking(world, a);
    raise_to(a.most_nefc.data[world], rows);
    if (world == 0) {
        raise_to(a.most_pool.data[0], contacts);
        raise_to(a.most_pool.data[1], pairs);
    }
}

}
