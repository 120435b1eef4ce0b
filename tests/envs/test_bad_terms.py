"""Terms and settings that cannot be are refused in one line that names them; a task may do without rewards."""

import dataclasses

import numpy as np
import pytest
import torch

from ksim_rl import conf, envs
from ksim_rl.cli.errors import FAILED, report
from ksim_rl.envs.step_counts import episode_steps
from ksim_rl.envs.term import CurriculumTerm, ObservationTerm, RewardTerm
from ksim_rl.transforms import ObservationTermCfg
from ksim_rl.transforms.delay import DelayCfg

TASK = "cartpole_balance"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Riddle(RewardTerm):
    """Returns what it was given, or raises it."""

    given: object = None

    def __call__(self, view):
        if isinstance(self.given, BaseException):
            raise self.given
        return self.given


@dataclasses.dataclass(frozen=True, kw_only=True)
class Blank(ObservationTerm):
    """Returns nothing."""

    def __call__(self, view):
        return None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Level(CurriculumTerm):
    """Returns a number."""

    def __call__(self, view, reset_E):
        return 1.0


def config(**changes):
    return dataclasses.replace(envs.make_cfg(TASK, ["task.scene.num_envs=2"]), **changes)


@pytest.mark.parametrize(
    "given", [None, 1.0, [1.0, 2.0], "a", np.ones(2)], ids=lambda given: type(given).__name__
)
def test_what_is_no_tensor_is_refused_with_its_term(given):
    with pytest.raises(
        ValueError, match=f"reward term 'riddle' returns {type(given).__name__}: expected a tensor"
    ):
        envs.build(config(rewards={"riddle": Riddle(given=given)}))


def test_an_observation_that_is_no_tensor_is_refused_with_its_term():
    group = dataclasses.replace(
        config().observations["actor"], terms={"blank": ObservationTermCfg(term=Blank())}
    )
    with pytest.raises(ValueError, match="observations.blank: returns NoneType"):
        envs.build(config(observations={"actor": group}))


@pytest.mark.parametrize(
    "error", [KeyError("own"), RuntimeError("own"), ZeroDivisionError("own")], ids=repr
)
def test_what_a_term_raises_is_told_with_its_term(error, capsys):
    with pytest.raises(type(error)) as raised:
        envs.build(config(rewards={"riddle": Riddle(given=error)}))
    assert report(raised.value) == FAILED
    assert "own" in (said := capsys.readouterr().err.splitlines()[-1]) and said.endswith(
        "(in rewards.riddle)"
    )


@pytest.mark.parametrize("code", [0, 1, None])
def test_a_term_does_not_end_the_program(code):
    with pytest.raises(RuntimeError, match="rewards.riddle: it ends the program"):
        envs.build(config(rewards={"riddle": Riddle(given=SystemExit(code))}))


def test_a_task_without_rewards_gives_none():
    env = envs.build(config(rewards={}))
    assert not env.rollout(3)["next", "reward"].any()
    env.close()


def test_a_run_without_actions_is_refused():
    with pytest.raises(ValueError, match="task.actions is empty: a policy needs one"):
        conf.compose([f"task={TASK}", "~task.actions.force"])


def test_a_weight_beyond_float32_is_refused():
    with pytest.raises(ValueError, match="weight=1e\\+38"):
        Riddle(weight=1e38)


def test_episodes_of_more_steps_than_are_counted_are_refused():
    with pytest.raises(ValueError, match="episode_length_s=10 is 1e\\+31 env steps"):
        episode_steps(config(), 1e-30)


@pytest.mark.parametrize(("lag", "fits"), [(999, True), (1000, False)])
def test_a_delay_as_long_as_an_episode_is_refused(lag, fits):
    cfg = config()
    actor = dataclasses.replace(cfg.observations["actor"], delay=DelayCfg(max_lag=lag))
    cfg = dataclasses.replace(cfg, observations={**cfg.observations, "actor": actor})
    if fits:
        assert episode_steps(cfg, 0.01) == 1000
        return
    with pytest.raises(
        ValueError, match="observations.actor.delay.max_lag=1000: an episode has 1000 env steps"
    ):
        episode_steps(cfg, 0.01)


def test_numbers_of_steps_are_as_before():
    assert episode_steps(config(episode_length_s=20.0), 0.02) == 1000
    assert torch.tensor(episode_steps(config(), 0.01), dtype=torch.int32) == 1000


def test_complex_values_and_other_devices_are_refused_with_their_term():
    for given, said in (
        (torch.ones(2, dtype=torch.complex64), "returns torch.complex64"),
        (torch.ones(2, device="meta"), "on meta"),
    ):
        with pytest.raises(ValueError, match=f"reward term 'riddle' .*{said}"):
            envs.build(config(rewards={"riddle": Riddle(given=given)}))


def test_a_level_that_is_no_tensor_is_refused_with_its_term():
    with pytest.raises(
        ValueError, match="curriculum term 'steps' returns float: expected a tensor"
    ):
        envs.build(config(curriculum={"steps": Level()}))


def test_an_action_that_selects_nothing_is_refused():
    actions = config().actions
    force = dataclasses.replace(actions["force"], joints=[])
    with pytest.raises(ValueError, match="actions.force: it takes no number of the action"):
        envs.build(config(actions={"force": force}))
