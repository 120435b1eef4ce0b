"""A step must compute all that it reads: inside a graph, what an earlier step computed would stay as it was."""

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from ksim_rl.envs import ManagerBasedRlEnv
from ksim_rl.envs.term import EventTerm
from ksim_rl.envs.view import EnvView
from tests.envs.probe_env import puck_cfg
from tests.mdp.busy_env import busy_env, write_clip
from tests.mdp.every_term_env import actions, every_term_env

STEPS = 16


def spoiled(value: Tensor) -> Tensor:
    """Return something useless of the same kind; not in place, as a quantity may be a view of the state."""
    return ~value if value.dtype == torch.bool else torch.full_like(value, 77)


def spoil_caches(env: ManagerBasedRlEnv) -> None:
    """Make all quantities that were computed so far useless."""
    for cache in env.driver._caches:
        cache.update({name: tree_map(spoiled, value) for name, value in cache.items()})


def roots(
    env: ManagerBasedRlEnv, chosen: Tensor, spoil: Callable[[], None]
) -> list[dict[str, Tensor]]:
    env.seed(3)
    root, seen = env.reset(), []
    for action_EL in chosen:
        spoil()
        step = env.step(root.set("action", action_EL))
        spoil()
        root = env.maybe_reset(step["next"].exclude("reward"))
        seen.append({str(key): root[key].clone() for key in root.keys(True, True)})
    return seen


@pytest.mark.parametrize("kind", ["every_term", "busy"])
def test_no_step_reads_what_an_earlier_one_computed(kind, tmp_path):
    if kind == "every_term":
        env = every_term_env(4)
        chosen = actions(STEPS, env)
    else:
        env = busy_env(write_clip(tmp_path / "clip.npz"))
        chosen = torch.sin(torch.arange(STEPS * env.num_envs, dtype=torch.float32)).view(
            STEPS, -1, 1
        )
    start = {key: value.clone() for key, value in env.state_dict().items()}
    expected = roots(env, chosen, lambda: None)
    env.load_state_dict(start)
    actual = roots(env, chosen, lambda: spoil_caches(env))
    for step, (one, other) in enumerate(zip(actual, expected, strict=True)):
        for key in other:
            assert torch.equal(one[key], other[key]), (step, key)
    env.close()


@dataclass(frozen=True, kw_only=True)
class Peek(EventTerm):
    """Read where a body is."""

    def __call__(self, view: EnvView, mask_E: Tensor) -> None:
        assert view.bodies("puck").pos_EN3.isfinite().all()


def test_a_step_still_refuses_to_read_what_a_write_from_outside_made_stale():
    env = ManagerBasedRlEnv(puck_cfg(events={"peek": Peek(mode="step")}))
    root, everybody_E = env.reset(), torch.ones(env.num_envs, dtype=torch.bool)
    env.view.joints().write_pos(everybody_E, torch.ones(env.num_envs, 1))
    with pytest.raises(RuntimeError, match="events/peek reads a derived quantity"):
        env.step(env.rand_action(root))
    env.close()
