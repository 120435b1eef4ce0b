// The copy of one row, whose units the lanes of a warp share; copying.py calls it for each tensor.
#pragma once
#include "builtin.h"

namespace copying {

namespace given {
constexpr int LANES = 32;
}

template <class Unit>
CUDA_CALLABLE inline void copy_row(
    int row, int lane, Unit* to, const Unit* from, size_t width, size_t to_stride, size_t from_stride
)
{
    for (size_t i = lane; i < width; i += given::LANES)
        to[row * to_stride + i] = from[row * from_stride + i];
}

}
