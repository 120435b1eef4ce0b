"""Transforms of a task in exports: what becomes a part of the policy, a stage of actions, or is left out or refused."""

import dataclasses
import json
import subprocess
import sys

import numpy as np
import onnxruntime
import pytest
import torch
from torchrl.envs.transforms import Transform
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ksim_rl import envs
from ksim_rl.export import NotDescribedError, stage
from ksim_rl.export.exported_transforms import check_equal, sort_transforms
from ksim_rl.modules import update_normalizers
from ksim_rl.trainers.algorithm import make_policy
from ksim_rl.trainers.build import build_env
from ksim_rl.trainers.run_cfg import RunCfg
from ksim_rl.transforms import (
    ActionDelay,
    ActionScale,
    DelayCfg,
    GaussianNoise,
    ObservationClip,
    ObservationDelay,
    ObservationNoise,
    RewardScale,
    TransformCfg,
)
from tests.export.test_lacks import lines
from tests.export.test_sim2sim import exported

NOISE = TransformCfg(ObservationNoise, in_keys=["actor"], noise=GaussianNoise(std=0.1))


class Squashed(Transform):
    """The tanh of each number."""

    def __init__(self, key: str = "actor") -> None:
        super().__init__(in_keys=[key], out_keys=[key])

    def _apply_transform(self, obs):
        return torch.tanh(obs)

    def _reset(self, tensordict, tensordict_reset):
        return self._call(tensordict_reset)


class Counting(Squashed):
    """Adds the number of its calls."""

    def _apply_transform(self, obs):
        self.calls = getattr(self, "calls", 0) + 1
        return obs + 0.01 * self.calls


class Stepping(Squashed):
    """Does something of its own in steps."""

    def _step(self, tensordict, next_tensordict):
        return self._call(next_tensordict)


class Shaken(Stepping):
    acts_in_training_only = True


class Halved(Transform):
    """The env gets half of the action."""

    def __init__(self) -> None:
        super().__init__(in_keys_inv=["action"], out_keys_inv=["action"])

    def _inv_apply_transform(self, action):
        return 0.5 * action


class Doubled(Halved):
    def _inv_apply_transform(self, action):
        return 2.0 * action


@stage.register(Doubled)
def _doubled(transform):
    return {"kind": "scale", "scale": 2.0, "offset": 0.0}


def adding(**transforms):
    return lambda cfg: dataclasses.replace(cfg, transforms={**cfg.transforms, **transforms})


def sorted_with(**transforms):
    return sort_transforms(adding(**transforms)(envs.task("cartpole_balance").cfg()), ["actor"])


def test_what_acts_on_observations_is_a_part_of_the_policy(tmp_path):
    own = {
        "noise": NOISE,
        "squashed": TransformCfg(Squashed),
        "clipped": TransformCfg(ObservationClip, in_keys=["actor"], clip=(-0.3, 0.4)),
        "reward": TransformCfg(RewardScale, scale=2.0),
    }
    folder = exported("cartpole_balance", tmp_path / "export", episodes=1, change=adding(**own))
    found = envs.task("cartpole_balance")
    settings = {f.name: getattr(found.training, f.name) for f in dataclasses.fields(found.training)}
    cfg = RunCfg(**settings, task_name="x", task=adding(**own)(found.cfg()), device="cpu")
    raw_BL = np.random.default_rng(0).normal(size=(5, 5)).astype(np.float32)
    session = onnxruntime.InferenceSession(str(folder / "policy.onnx"))
    (actions, *_) = session.run(None, {"obs": raw_BL})
    # The same weights as `exported` drew, asked about the observation as the formulas have it.
    torch.manual_seed(3)
    env = build_env(cfg, num_envs=4, seed=5)
    actor = make_policy(cfg, env)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        update_normalizers(env.rollout(20, break_when_any_done=False), actor)
    seen_BL = torch.tensor(np.clip(np.tanh(raw_BL), -0.3, 0.4))
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        expected = actor(envs.make("cartpole_balance", num_envs=5).reset().set("actor", seen_BL))[
            "action"
        ]
    np.testing.assert_allclose(actions, expected.numpy(), atol=1e-5)
    # Its own program runs it, on raw observations.
    done = subprocess.run(
        [sys.executable, folder / "runner.py", "--episodes", "1"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    ours = json.loads((folder / "export.json").read_text())["ours"]["return"][0]
    theirs = float(done.stdout.split("return")[1].split("+-")[0])
    assert theirs == pytest.approx(ours, rel=1e-2)


def test_a_state_that_hides_in_a_function_of_observations_is_found():
    task = envs.task("cartpole_balance").cfg()
    whole = adding(counting=TransformCfg(Counting))(task)
    envs_of = [
        envs.build(
            dataclasses.replace(cfg, scene=dataclasses.replace(cfg.scene, num_envs=2), seed=1)
        )
        for cfg in (whole, task)
    ]
    with pytest.raises(
        NotDescribedError, match=r"task.transforms.counting: observation 'actor' differs at step"
    ):
        check_equal(*envs_of, sort_transforms(whole, ["actor"]), ["actor"])


def test_noise_and_what_says_so_act_in_training_only():
    found = sorted_with(noise=NOISE, shaken=TransformCfg(Shaken))
    assert found.training_only == ["noise", "shaken"] and not found.in_policy


def test_what_the_policy_does_not_read_is_no_matter():
    late = TransformCfg(ObservationDelay, in_keys=["critic"], delay=DelayCfg(min_lag=1, max_lag=1))
    found = sorted_with(late=late, reward=TransformCfg(RewardScale, scale=2.0))
    assert not found.removed and not found.stages


def test_actions_meet_the_last_transform_first():
    found = sorted_with(
        late=TransformCfg(ActionDelay, delay=DelayCfg(min_lag=1, max_lag=2)),
        scaled=TransformCfg(ActionScale, scale=0.5, offset=0.1),
        doubled=TransformCfg(Doubled),
    )
    assert [one["kind"] for one in found.stages] == ["scale", "scale", "delay"]
    assert found.stages[0]["scale"] == 2.0 and found.stages[1]["offset"] == 0.1
    assert (found.stages[2]["min"], found.stages[2]["max"]) == (1, 2)


@pytest.mark.parametrize(
    ("transform", "message"),
    [
        (
            TransformCfg(Stepping),
            r"Stepping acts in evaluation.*it has _step.*acts_in_training_only = True",
        ),
        (
            TransformCfg(Halved),
            r"Halved has no description.*@ksim_rl.export.stage.register\(Halved\)",
        ),
        (TransformCfg(ActionScale), "give scale and offset"),
        (
            TransformCfg(ObservationDelay, in_keys=["actor"], delay=DelayCfg(min_lag=1, max_lag=1)),
            "ObservationDelay acts in evaluation.*use the fields of observation groups",
        ),
        (
            TransformCfg(ObservationClip, in_keys=["critic"], out_keys=["actor"], clip=(0.0, 1.0)),
            "of 'critic', which the policy does not read",
        ),
    ],
)
def test_what_no_export_can_take_is_refused_by_name(transform, message):
    with pytest.raises(NotDescribedError, match=f"task.transforms.mine: .*{message}"):
        sorted_with(mine=transform)


def test_the_start_of_a_training_says_what_an_export_will_lack():
    (left_out,) = lines(adding(noise=NOISE))
    assert left_out == "task.transforms.noise acts in training only: an export leaves it out"
    (refused,) = lines(adding(mine=TransformCfg(Stepping)))
    assert refused.startswith(
        "`ksim-rl export` will refuse this run: task.transforms.mine: Stepping acts in eval"
    )
    assert lines(adding(squashed=TransformCfg(Squashed))) == []
