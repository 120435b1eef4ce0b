"""What the lanes of one warp do together: on CUDA 32 lanes share a world, on the CPU one lane has it all."""

# Native functions have no body in Python; Warp gives each as many values as it is asked for.
# pyright: reportReturnType=false

import functools

import warp as wp

CUDA_LANES = 32


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncwarp();
#endif
""")
def sync() -> None:
    """Let each lane see what the others have written."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
for (int distance = 16; distance > 0; distance >>= 1)
    value += __shfl_xor_sync(0xffffffffu, value, distance);
#endif
return value;
""")
def total(value: float) -> float:
    """Return the sum of the lanes' values, the same bits in all lanes."""
    ...


@functools.cache
def shared_floats(size: int, worlds_per_block: int) -> wp.Function:
    """Return a Warp function that gives the address of `size` floats that the lanes of a world share."""
    snippet = f"""
#if defined(__CUDA_ARCH__)
__shared__ float floats[{worlds_per_block * size}];
return (wp::uint64)(floats + (threadIdx.x / {CUDA_LANES}) * {size});
#else
static float floats[{size}];
return (wp::uint64)floats;
#endif
"""

    @wp.func_native(snippet)
    def address() -> wp.uint64: ...

    return address
