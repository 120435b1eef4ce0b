import pytest
import torch
from torchrl.envs import TransformedEnv

from ksim_rl.envs.masked_reset import MaskedReset
from ksim_rl.testing import CounterEnv, check_env


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


def test_a_good_env_passes():
    check_env(Masked())


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (Accepting, "accepted an action with one element more"),
        (NotFinite, r"'count' is not finite at reset, in the rows \[1\]"),
        (OutsideItsSpec, "'drawn' leaves its spec"),
        (Unnamed, r"full_observation_spec\['obs'\] has the names \[None\]"),
        (lambda: TransformedEnv(CounterEnv()), r"has dims \[None\]"),
    ],
)
def test_what_is_wrong_is_named(env, message):
    with pytest.raises(AssertionError, match=message):
        check_env(env())


def test_the_refusal_of_actions_can_be_skipped():
    check_env(Accepting(), check_actions=False)
