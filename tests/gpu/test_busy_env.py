"""Commands, events, terminations, metrics and curricula inside a CUDA graph."""

import pytest
import torch

from ksim_rl.physics import Captured, SimCfg
from tests.gpu.no_syncs import no_syncs
from tests.mdp.busy_env import NUM_ENVS, busy_env, write_clip

STEPS = 24


def run(clip: str, *, captured: bool):
    """Roots after each step and the log in the end, on the CPU; `captured` replays a graph from the third step on."""
    env = busy_env(clip, device="cuda", sim=SimCfg())
    chosen = torch.sin(torch.arange(STEPS * NUM_ENVS, device="cuda", dtype=torch.float32)).view(
        STEPS, -1, 1
    )
    root_E, action = env.reset(), torch.zeros(NUM_ENVS, 1, device="cuda")

    def body() -> None:
        _, after_E = env.step_and_maybe_reset(root_E.copy().set("action", action))
        for key in list(root_E.keys(True, True)):
            root_E.get(key).copy_(after_E.get(key))

    step = Captured(body, device="cuda", warmup=2 if captured else STEPS, require_graphs=True)
    roots = []
    for n in range(STEPS):
        action.copy_(chosen[n])
        if n == 12:
            env.command_manager.set("stick", [0.5])
        step()
        roots.append(root_E.clone().cpu())
    assert step.ready == captured
    numbers = env.episode_log() | env.curriculum_levels() | env.command_levels()
    return roots, {name: float(value) for name, value in numbers.items()}


@pytest.mark.gpu
def test_a_captured_step_gives_what_an_eager_one_gives(tmp_path):
    clip = write_clip(tmp_path / "sink.npz")
    (roots, numbers), (expected_roots, expected) = (
        run(clip, captured=True),
        run(clip, captured=False),
    )
    for n, (actual_E, expected_E) in enumerate(zip(roots, expected_roots, strict=True)):
        for key in expected_E.keys(True, True):
            torch.testing.assert_close(
                actual_E[key], expected_E[key], rtol=1e-4, atol=1e-4, msg=f"{n} {key}"
            )
    assert numbers == pytest.approx(expected, rel=1e-3, abs=1e-4)
    assert roots[-1]["command", "stick"].eq(0.5).all(), (
        "a graph sees what was set between two replays"
    )


@pytest.mark.gpu
def test_steps_and_resets_do_not_synchronize(tmp_path):
    env = busy_env(write_clip(tmp_path / "sink.npz"), device="cuda")
    root_E, action = env.reset(), torch.ones(NUM_ENVS, 1, device="cuda")
    for _ in range(3):
        _, root_E = env.step_and_maybe_reset(root_E.set("action", action))
    with no_syncs():
        for _ in range(STEPS):
            _, root_E = env.step_and_maybe_reset(root_E.set("action", action))
