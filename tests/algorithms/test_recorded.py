"""Recorded episodes are compared with the env of a run that learns from them, and refused by what differs."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from ksim_rl import envs
from ksim_rl.algorithms.recorded import check_origin
from ksim_rl.data.episode_folder import EPISODE, Contents, Origin
from ksim_rl.trainers.recorders import origin_of

OVERRIDES = ["task.scene.num_envs=1", "task.sim.engine=c"]


def test_another_rate_or_model_is_refused_and_an_unknown_one_noted():
    env = envs.build(envs.make_cfg("cartpole_balance", OVERRIDES), device="cpu")
    origin = origin_of(SimpleNamespace(task_name="made_up"), env, title="made up")

    def compared(**changed):
        found = Contents(leaves=(EPISODE,), origin=replace(origin, **changed))
        return check_origin(found, env)

    assert compared() == []
    with pytest.raises(ValueError, match="step_dt: a step of its env took 0.5 s, and here one"):
        compared(step_dt=0.5)
    with pytest.raises(ValueError, match="model_sha256: its MuJoCo model was 00, and this run's"):
        compared(model_sha256="00")
    unknown = Contents(leaves=(EPISODE,), origin=Origin())
    assert check_origin(unknown, env) == ["the seconds of a step", "the MuJoCo model"]
