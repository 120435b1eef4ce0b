"""Tasks by name, with Hydra overrides."""

from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from ksim_rl import envs
from ksim_rl.envs import EnvView
from ksim_rl.envs.term import EventTerm


def test_names_are_sorted_and_hold_the_reference_tasks():
    assert {"cartpole_balance", "cartpole_swingup", "go1_velocity_flat"} <= set(envs.names())
    assert envs.names() == sorted(envs.names())


def test_a_typo_in_a_task_gives_the_near_names():
    with pytest.raises(ValueError, match="did you mean .*'cartpole_swingup'"):
        envs.make_cfg("cartpole_swing_up")


def test_overrides_reach_every_level():
    cfg = envs.make_cfg(
        "cartpole_balance",
        [
            "task.decimation=2",
            "task.events.reset.cart_range=0.5",
            "task.scene.num_envs=7",
            "task.sim.timestep=0.005",
        ],
    )
    assert (cfg.decimation, cfg.scene.num_envs, cfg.sim.timestep) == (2, 7, 0.005)
    assert cfg.events is not None and cfg.events["reset"].cart_range == 0.5  # pyright: ignore


def test_terms_can_be_added_and_removed():
    added = "+task.rewards.extra={_target_: ksim_rl.tasks.cartpole.CartpoleReward, weight: 2.0}"
    cfg = envs.make_cfg("cartpole_balance", [added, "~task.rewards.balance"])
    assert list(cfg.rewards) == ["extra"] and cfg.rewards["extra"].weight == 2.0


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("task.decimatoin=2", "did you mean 'decimation'"),
        ("task.rewards.balanse.weight=2", "did you mean 'balance'"),
        ("taks.decimation=2", "did you mean 'task'"),
        ("task.decimation=[", "does not parse"),
        ("task.decimation=half", "task.decimation='half': expected int"),
    ],
)
def test_a_wrong_override_names_the_near_fields(override, message):
    with pytest.raises(ValueError, match=message):
        envs.make_cfg("cartpole_balance", [override])


def test_make_gives_the_env_ready_to_train_on():
    env = envs.make(
        "cartpole_balance", num_envs=4, seed=3, overrides=["task.episode_length_s=0.05"]
    )
    root_E = env.reset()
    assert root_E["actor"].shape == (4, 5) and root_E["critic"].shape == (4, 5)
    assert env.action_spec.shape == (4, 1) and env.base_env.cfg.seed == 3
    assert env.rollout(7, break_when_any_done=False)["next", "truncated"][:, 4].all()


STARTS: list[float] = []


@dataclass(frozen=True, kw_only=True)
class NotesStarts(EventTerm):
    """Notes what it draws each time that it is asked to write rows."""

    mode: str = "startup"

    def __call__(self, view: EnvView, mask_E: Tensor) -> None:
        if mask_E.any():
            STARTS.append(view.uniform(1)[0].item())


def test_startup_events_run_once_for_each_seed():
    cfg = envs.make_cfg("cartpole_balance", ["task.scene.num_envs=2", "task.seed=5"])
    STARTS.clear()
    env = envs.build(replace(cfg, events={**(cfg.events or {}), "notes": NotesStarts()}))
    assert len(STARTS) == 1
    built = {key: value.clone() for key, value in env.state_dict().items()}
    env.seed(5)
    assert len(STARTS) == 2 and STARTS[0] == STARTS[1]
    for key, value in env.state_dict().items():
        assert torch.equal(value, built[key]), f"{key}: building seeds as seed() does"
    env.close()
