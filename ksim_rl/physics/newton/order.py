"""A GPU takes up the worlds of the solver in an order that puts those first which will take longest.

A world that takes three times as long as most would otherwise start late and leave the GPU waiting for it alone. How
long it will take is told by its iterations of the substep before and by its rows.
"""

# Kernels are Python only in their spelling.
# pyright: reportInvalidTypeForm=false

import warp as wp

from ksim_rl.physics.newton.kernel import Problem

THREADS = 1024


@wp.func_native("""
#if defined(__CUDA_ARCH__)
constexpr int KEYS = 64;
__shared__ int places[KEYS];  // how many worlds have a key, then where the next of them goes
const int thread = threadIdx.x, threads = blockDim.x, worlds = problem.order.shape[0];
auto key_of = [&](int world) {
    const int time = 2 * problem.solver_niter.data[world] + problem.nefc.data[world] / 4;
    return KEYS - 1 - wp::min(time, KEYS - 1);
};
for (int key = thread; key < KEYS; key += threads)
    places[key] = 0;
__syncthreads();
for (int world = thread; world < worlds; world += threads)
    atomicAdd(places + key_of(world), 1);
__syncthreads();
if (thread == 0) {
    int before = 0;
    for (int key = 0; key < KEYS; ++key) {
        const int count = places[key];
        places[key] = before;
        before += count;
    }
}
__syncthreads();
for (int world = thread; world < worlds; world += threads)
    problem.order.data[atomicAdd(places + key_of(world), 1)] = world;
#endif
""")
def sort_by_counting(problem: Problem) -> None:
    """Write the worlds in the order of their keys."""


@wp.kernel(
    module="unique",
    enable_backward=False,
    grid_stride=False,
    module_options={"block_dim": THREADS},
)
def sort_worlds(problem: Problem):
    """Write the order of the worlds, by one block."""
    sort_by_counting(problem)


def put_longest_first(problem: Problem) -> None:
    """Launch the kernel that orders the worlds of `problem`, on CUDA."""
    wp.launch(sort_worlds, dim=THREADS, inputs=[problem], block_dim=THREADS)
