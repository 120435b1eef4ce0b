// The record of overflow by itself, where no integration keeps it.
#pragma once
#include "ksim_rl/physics/smooth/needs.cuh"

namespace record {

using namespace needs;

struct Arguments : NeedsArguments {
};

CUDA_CALLABLE inline void run(int world, int lane, const Arguments& a)
{
    if (lane == 0)
        keep_needs(world, a);
}

}
