"""Every observation and reward inside a CUDA graph; on machines without a GPU the sync counter stands in for it."""

import pytest
import torch

from ksim_rl.physics import Captured
from tests.gpu.no_syncs import no_syncs
from tests.mdp.every_term_env import REWARDS, actions, every_term_env

STEPS = 20
OF_THE_LAST_SUBSTEP = (
    "Acc",
    "Effort",
    "Force",
    "Contact",
    "Energy",
    "SensorReading",
    "SoftLanding",
)
"""Words in the names of terms that read the acceleration stage."""


def run(*, captured: bool):
    """Roots before and rewards of each step, on the CPU; `captured` replays a graph from the third step on."""
    env = every_term_env(16, "cuda")
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


def check_alike(
    actual: torch.Tensor, expected: torch.Tensor, again: torch.Tensor, what: str
) -> None:
    """Allow nine values of ten to differ as much as two eager runs may, and a little of the largest one.

    The physics of contacts is not the same from run to run on a GPU, least of all its accelerations and forces.
    """
    actual, expected, again = (value.float().flatten() for value in (actual, expected, again))
    share = 2e-2 if any(word in what for word in OF_THE_LAST_SUBSTEP) else 1e-3
    error, noise = ((value - expected).abs().quantile(0.9) for value in (actual, again))
    assert error <= 10.0 * noise + share * expected.abs().max() + 1e-4, (
        f"{what}: {error} against {noise}"
    )


@pytest.mark.gpu
def test_terms_give_the_same_in_a_graph():
    graph, eager, again = run(captured=True), run(captured=False), run(captured=False)
    for n, (actual, expected, other) in enumerate(zip(graph, eager, again, strict=True)):
        for key in expected[0].keys(True, True):
            check_alike(actual[0][key], expected[0][key], other[0][key], f"{n} {key}")
        for column, name in enumerate(REWARDS):
            of_graph, of_eager, of_other = (
                rewards_ER[:, column] for _, rewards_ER in (actual, expected, other)
            )
            check_alike(of_graph, of_eager, of_other, f"{n} {name}")


@pytest.mark.gpu
def test_steps_and_resets_do_not_synchronize():
    env = every_term_env(16, "cuda")
    chosen, root_E = actions(STEPS, env).cuda(), env.reset()
    for n in range(3):
        _, root_E = env.step_and_maybe_reset(root_E.set("action", chosen[n]))
    with no_syncs():
        for n in range(3, STEPS):
            _, root_E = env.step_and_maybe_reset(root_E.set("action", chosen[n]))
