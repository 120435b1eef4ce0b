"""The whole chain inside a CUDA graph; on machines without a GPU the sync counter stands in for it."""

import pytest
import torch
from torchrl.envs.transforms import Compose

from ksim_rl.envs.masked_transformed_env import MaskedTransformedEnv
from ksim_rl.testing import CounterEnv
from tests.envs.transforms.chains import actions, full_chain


def on_gpu() -> MaskedTransformedEnv:
    env = MaskedTransformedEnv(CounterEnv((3, 5, 4, 7), device="cuda"), Compose(*full_chain()))
    env.set_seed(3)
    return env


@pytest.mark.gpu
def test_steps_and_resets_do_not_synchronize_and_replay_as_they_ran():
    eager, captured = on_gpu(), on_gpu()
    chosen = actions(30, eager).cuda()
    roots = [eager.reset(), captured.reset()]
    root = roots[1].clone()
    action = torch.zeros_like(chosen[0])

    def body() -> None:
        _, after = captured.step_and_maybe_reset(root.copy().set("action", action))
        for key in list(root.keys(True, True)):
            root.get(key).copy_(after.get(key))

    def check(step: int) -> None:
        _, roots[0] = eager.step_and_maybe_reset(roots[0].set("action", chosen[step]))
        for key, value in root.items(True, True):
            assert torch.equal(value, roots[0][key]), (step, key)

    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        torch.cuda.set_sync_debug_mode("error")
        try:
            for step in range(3):
                action.copy_(chosen[step])
                body()
        finally:
            torch.cuda.set_sync_debug_mode("default")
        torch.cuda.synchronize()
        for step in range(3):
            _, roots[0] = eager.step_and_maybe_reset(roots[0].set("action", chosen[step]))
        graph = torch.cuda.CUDAGraph()
        graph.capture_begin(capture_error_mode="thread_local")
        body()
        graph.capture_end()
        for step in range(3, 30):
            action.copy_(chosen[step])
            graph.replay()
            torch.cuda.synchronize()
            check(step)
