// The second half of the lists, where no kernel of constraint rows makes it on its way: their order.
#pragma once
#include "ksim_rl/physics/rows/contact_order.cuh"

namespace contact_lists {

using namespace contact_order;

struct Arguments : ListArguments {
};

CUDA_CALLABLE inline void run(int index, int lane, const Arguments& a)
{
    order_contacts(world_of(index, lane), a);
}

}
