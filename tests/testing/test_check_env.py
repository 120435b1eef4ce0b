from typing import ClassVar

import pytest
import torch
from torchrl.envs import TransformedEnv

from ksim_rl.envs import MaskedTransformedEnv
from ksim_rl.envs.masked_reset import MaskedReset
from ksim_rl.envs.term import RewardTerm
from ksim_rl.testing import CounterEnv, check_env
from ksim_rl.testing.check_env import CHECKS
from ksim_rl.transforms import ObservationScale
from tests.envs.probe_env import puck_env


class Masked(MaskedReset, CounterEnv):
    pass


class Accepting(Masked):
    """Takes whatever action there is."""

    def _step(self, tensordict):
        action = tensordict["action"].float().reshape(3, -1)[:, :1].expand(3, 2)
        return super()._step(tensordict.clone(False).set("action", action.contiguous()))


class NotFinite(Masked):
    def _observe(self):
        observed = super()._observe()
        observed["count"] = torch.where(self.row_E[:, None] == 1, torch.nan, observed["count"])
        return observed


class OutsideItsSpec(Masked):
    def _observe(self):
        observed = super()._observe()
        return observed | {"drawn": observed["drawn"] + 1}


class Unnamed(Masked):
    def __init__(self):
        super().__init__()
        self.set_spec_lock_(False)
        self.full_observation_spec["obs"].names = None


class FromTheGlobalGenerator(Masked):
    """Draws from torch's default generator, which no seed of the env reaches, in `_step`."""

    def _step(self, tensordict):
        stepped = super()._step(tensordict)
        return stepped.set("row", stepped["row"] + torch.rand(3, 1))


class SharedDraw(Masked):
    """One counter for all rows: a reset of one row changes the numbers of the others."""

    def _observe(self):
        observed = super()._observe()
        return observed | {"drawn": observed["drawn"] * 0 + (self.episode_E.sum() % 7) / 10.0}


class ResetsEverybody(Masked):
    def _reset(self, tensordict=None, **kwargs):
        if tensordict is not None and tensordict.get("_reset", None) is not None:
            tensordict = tensordict.clone().set("_reset", tensordict["_reset"].any().expand(3, 1))
        return super()._reset(tensordict, **kwargs)


class ObservesTheNextEpisode(Masked):
    """Resets in `_step`, as some simulators do: the terminal observation is lost."""

    def _step(self, tensordict):
        stepped = super()._step(tensordict)
        ended_E1 = stepped["done"]
        self.count_E.masked_fill_(ended_E1[:, 0], 0)
        self.episode_E.add_(ended_E1[:, 0])
        fresh = self._observe()
        for key in ("count", "episode", "drawn"):
            stepped[key] = torch.where(ended_E1, fresh[key], stepped[key])
        stepped["obs", "vector"] = torch.where(
            ended_E1, fresh["obs"]["vector"], stepped["obs", "vector"]
        )
        return stepped

    def _reset(self, tensordict=None, **kwargs):
        self.episode_E.sub_(
            1 if tensordict is None else tensordict.get("_reset", torch.ones(3, 1)).flatten().long()
        )
        return super()._reset(tensordict, **kwargs)


class AdvancesTwice(Masked):
    """Its root after a step is not the observation that the step returned, in rows that go on."""

    def maybe_reset(self, tensordict):
        root = super().maybe_reset(tensordict)
        return root.set("row", root["row"] + 1)


class Waits(Masked):
    def _step(self, tensordict):
        stepped = super()._step(tensordict)
        if bool(stepped["done"].any()):
            self.waited = True
        return stepped


class Hoards(Masked):
    def __init__(self):
        super().__init__()
        self.kept = []

    def _step(self, tensordict):
        stepped = super()._step(tensordict)
        self.kept.append(stepped["reward"].clone())
        return stepped


def test_a_good_env_passes():
    check_env(Masked(), num_steps=6)


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (Accepting, "accepted an action with one element more"),
        (NotFinite, r"'count' is not finite at reset, in the rows \[1\]"),
        (OutsideItsSpec, "'drawn' leaves its spec"),
        (Unnamed, r"full_observation_spec\['obs'\] has the names \[None\]"),
        (lambda: TransformedEnv(CounterEnv()), r"has dims \[None\]"),
        (FromTheGlobalGenerator, r"\[determinism\] .*'row'.* Draw all random numbers"),
        (SharedDraw, r"\[partial_reset\] .*'drawn'.*never reset.*a generator"),
        (ResetsEverybody, r"\[partial_reset\] 'episode_E' of the state.*Write through the mask"),
        (
            ObservesTheNextEpisode,
            r"\[episode_end\] row 0 ended, and its `next` observation is of the new episode",
        ),
        (AdvancesTwice, r"\[episode_end\] 'row' differ between `next` and the next root"),
        (Waits, r"\[syncs\] .*make the host wait"),
        (Hoards, r"\[memory\] 10 steps leave 1\d tensors behind"),
    ],
)
def test_what_is_wrong_is_named(env, message):
    with pytest.raises(AssertionError, match=message):
        check_env(env(), num_steps=6)


class Counting(RewardTerm):
    """Counts its own calls."""

    calls: ClassVar[list[int]] = []

    def __call__(self, view):
        self.calls.append(1)
        return torch.zeros(view.num_envs)


def test_python_that_changes_is_named_where_steps_are_recorded():
    env = puck_env(rewards={"counting": Counting()})
    with pytest.raises(
        AssertionError, match=r"\[python\] rewards\.counting: Counting\.calls\[\d+\]"
    ):
        check_env(env, skip=[name for name in CHECKS if name != "python"])


def test_all_findings_come_at_once():
    with pytest.raises(AssertionError) as found:
        check_env(NotFinite(), num_steps=6)
    assert "[values]" in str(found.value) and "NotFinite has" in str(found.value)


def test_unknown_checks_are_refused():
    with pytest.raises(ValueError, match="unknown check 'sync': did you mean 'syncs'"):
        check_env(Masked(), skip=["sync"])


def test_the_refusal_of_actions_can_be_skipped():
    check_env(Accepting(), skip=["actions"])


def test_the_sign_of_a_zero_is_kept():
    # The counts are 0 after a reset, and times -1 they are negative zeros.
    env = MaskedTransformedEnv(CounterEnv(), [ObservationScale(["count"], scale=-1.0)])
    check_env(env, num_steps=5, skip=("memory",))
