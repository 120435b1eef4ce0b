"""How conditions combine into `terminated`, `truncated` and `done`."""

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from ksim_rl.envs import EnvView
from ksim_rl.envs.term import TerminationTerm
from tests.envs.probe_env import puck_cfg, puck_env_in_c, push

FAILED, LATE = (True, False, True, False), (False, True, True, False)


@dataclass(frozen=True, kw_only=True)
class Returns(TerminationTerm):
    """Returns the same flags always, as they are."""

    flags: tuple
    dtype: torch.dtype = torch.bool

    def __call__(self, view: EnvView) -> Tensor:
        return torch.tensor(self.flags, dtype=self.dtype)


def ending(*terms, **fields):
    terminations = {f"term_{i}": term for i, term in enumerate(terms)}
    return puck_env_in_c(num_envs=4, terminations=terminations, episode_length_s=10.0, **fields)


def flags_of(env):
    next_E = push(env, env.reset())["next"]
    for name in ("terminated", "truncated", "done"):
        assert next_E[name].shape == (4, 1) and next_E[name].dtype == torch.bool
    return tuple(tuple(next_E[name][:, 0].tolist()) for name in ("terminated", "truncated", "done"))


def test_time_outs_truncate_and_all_others_terminate():
    env = ending(Returns(flags=FAILED), Returns(flags=LATE, time_out=True))
    assert flags_of(env) == (FAILED, LATE, (True, True, True, False))


def test_in_a_finite_horizon_both_terminate():
    env = ending(Returns(flags=FAILED), Returns(flags=LATE, time_out=True), is_finite_horizon=True)
    either, neither = (True, True, True, False), (False,) * 4
    assert flags_of(env) == (either, neither, either)


def test_terms_of_one_kind_are_joined_by_or_and_counted_apart():
    env = ending(Returns(flags=FAILED), Returns(flags=LATE))
    assert flags_of(env)[0] == (True, True, True, False)
    log = env.episode_log()
    assert (
        log["termination/term_0"],
        log["termination/term_1"],
        log["termination/non_finite"],
    ) == (2, 2, 0)
    assert log["episodes"] == 3, "a row that ends for two reasons is one episode"


def test_without_terms_only_failed_physics_ends_an_episode():
    env = ending()
    assert flags_of(env) == ((False,) * 4,) * 3
    root_E = env.reset()
    env.world.qvel_EL[2] = torch.nan
    next_E = push(env, root_E)["next"]
    assert next_E["terminated"][:, 0].tolist() == [False, False, True, False]
    assert not next_E["truncated"].any()


@pytest.mark.parametrize(
    ("term", "message"),
    [
        (
            Returns(flags=(1.0, 0.0, 0.0, 0.0), dtype=torch.float32),
            r"returns torch\.float32 \(4,\)",
        ),
        (
            Returns(flags=((True,),) * 4),
            r"returns torch\.bool \(4, 1\): expected torch\.bool \(4,\)",
        ),
        (Returns(flags=(True,)), r"returns torch\.bool \(1,\)"),
    ],
)
def test_flags_of_a_wrong_shape_or_dtype_are_refused_at_construction(term, message):
    with pytest.raises(ValueError, match="termination term 'term_0' " + message):
        ending(term)


def test_a_time_out_needs_an_episode_length():
    terms = {"late": Returns(flags=LATE, time_out=True)}
    with pytest.raises(
        ValueError, match=r"episode_length_s=0\.0 with the time-out termination 'late'"
    ):
        puck_cfg(terminations=terms, episode_length_s=0.0)
