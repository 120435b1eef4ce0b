"""Each transform, and the usual chain, in a CUDA graph; without a GPU the sync counter stands in for it."""

import pytest
import torch
from torchrl.envs.transforms import Compose

from ksim_rl.envs.masked_transformed_env import MaskedTransformedEnv
from ksim_rl.testing import CounterEnv
from tests.envs.transforms.chains import actions, full_chain
from tests.envs.transforms.transform_checks import KINDS


def on_gpu(kind: str) -> MaskedTransformedEnv:
    chain = full_chain() if kind == "chain" else [KINDS[kind]()]
    env = MaskedTransformedEnv(CounterEnv((3, 5, 4, 7), device="cuda"), Compose(*chain))
    env.set_seed(3)
    return env


@pytest.mark.gpu
@pytest.mark.parametrize("kind", ["chain", *KINDS])
def test_steps_and_resets_do_not_synchronize_and_replay_as_they_ran(kind):
    eager, captured = on_gpu(kind), on_gpu(kind)
    chosen, key = actions(30, eager).cuda(), eager.action_key
    roots = [eager.reset(), captured.reset()]
    root = roots[1].clone()
    action = torch.zeros_like(chosen[0])

    def body() -> None:
        _, after = captured.step_and_maybe_reset(root.copy().set(key, action))
        for name in list(root.keys(True, True)):
            root.get(name).copy_(after.get(name))

    def check(step: int) -> None:
        _, roots[0] = eager.step_and_maybe_reset(roots[0].set(key, chosen[step]))
        for name, value in root.items(True, True):
            assert torch.equal(value, roots[0][name]), (step, name)

    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        try:
            for step in range(3):
                action.copy_(chosen[step])
                body()
                # The first step builds the specs that the env keeps from then on.
                torch.cuda.set_sync_debug_mode("error")
        finally:
            torch.cuda.set_sync_debug_mode("default")
        torch.cuda.synchronize()
        for step in range(3):
            _, roots[0] = eager.step_and_maybe_reset(roots[0].set(key, chosen[step]))
        graph = torch.cuda.CUDAGraph()
        graph.capture_begin(capture_error_mode="thread_local")
        body()
        graph.capture_end()
        for step in range(3, 30):
            action.copy_(chosen[step])
            graph.replay()
            torch.cuda.synchronize()
            check(step)
