"""Every observation and reward inside a CUDA graph; on machines without a GPU the sync counter stands in for it."""

import pytest
import torch

from ksim_rl.physics import Captured
from tests.envs.mdp.every_term_env import REWARDS, actions, every_term_env

STEPS = 20


def run(*, captured: bool):
    """Roots before and rewards of each step, on the CPU; `captured` replays a graph from the third step on."""
    env = every_term_env(16, "cuda", deterministic=True)
    chosen, root_E = actions(STEPS, env).cuda(), env.reset()
    action, rewards_ER = torch.zeros_like(chosen[0]), torch.zeros(16, len(REWARDS), device="cuda")

    def body() -> None:
        before_ER = env.reward_manager.episode_sums_ER.clone()
        step_E = env.step(root_E.copy().set("action", action))
        rewards_ER.copy_(env.reward_manager.episode_sums_ER - before_ER)
        after_E = env.maybe_reset(step_E["next"].exclude("reward"))
        for key in list(root_E.keys(True, True)):
            root_E.get(key).copy_(after_E.get(key))

    step = Captured(body, device="cuda", warmup=2 if captured else STEPS, require_graphs=True)
    seen = []
    for n in range(STEPS):
        action.copy_(chosen[n])
        step()
        seen.append((root_E.clone().cpu(), rewards_ER.cpu().clone()))
    assert step.ready == captured
    return seen


@pytest.mark.gpu
def test_terms_give_the_same_in_a_graph():
    for n, (actual, expected) in enumerate(zip(run(captured=True), run(captured=False), strict=True)):
        for key in expected[0].keys(True, True):
            torch.testing.assert_close(
                actual[0][key], expected[0][key], rtol=1e-4, atol=1e-4, msg=f"{n} {key}"
            )
        for column, name in enumerate(REWARDS):
            torch.testing.assert_close(
                actual[1][:, column], expected[1][:, column], rtol=1e-3, atol=1e-4, msg=f"{n} {name}"
            )


@pytest.mark.gpu
def test_steps_and_resets_do_not_synchronize():
    env = every_term_env(16, "cuda")
    chosen, root_E = actions(STEPS, env).cuda(), env.reset()
    for n in range(3):
        _, root_E = env.step_and_maybe_reset(root_E.set("action", chosen[n]))
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        for n in range(3, STEPS):
            _, root_E = env.step_and_maybe_reset(root_E.set("action", chosen[n]))
    finally:
        torch.cuda.set_sync_debug_mode("default")
