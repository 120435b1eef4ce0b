"""Kernels that are loaded together; a kernel that has not run must not have run."""

import torch
import warp as wp

from ksim_rl.device.kernel_loading import loaded_together
from ksim_rl.device.streams import warp_scope

CPU = torch.device("cpu")


@wp.kernel(module="unique", enable_backward=False)
def add_one(values: wp.array[float]):
    values[wp.tid()] += 1.0


def test_launches_of_the_block_are_loaded_and_not_run():
    with warp_scope(CPU):
        values = wp.zeros(3, dtype=float, device="cpu")
        assert not add_one.module.execs
        with loaded_together(CPU):
            wp.launch(add_one, 3, inputs=[values], device="cpu")
            wp.launch(add_one, dim=0, inputs=[values], device="cpu")
        assert add_one.module.execs
        assert values.numpy().tolist() == [0.0] * 3
        wp.launch(add_one, dim=3, inputs=[values], device="cpu")
        assert values.numpy().tolist() == [1.0] * 3
