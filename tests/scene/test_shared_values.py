"""Values that all envs share: made once, kept over resets, saved."""

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from ksim_rl.envs import EnvView
from ksim_rl.envs.term import CurriculumTerm
from ksim_rl.scene.state.buffers import SharedValues
from tests.envs.probe_env import puck_env


@dataclass(frozen=True, kw_only=True)
class Counts(CurriculumTerm):
    """Counts the rows that reset, from 10 on."""

    def __call__(self, view: EnvView, mask_E: Tensor) -> Tensor:
        return view.shared("count", 10.0).add_(mask_E.sum()).clone()


def test_a_value_starts_as_told_and_is_one_tensor_for_ever():
    values = SharedValues(torch.device("cpu"))
    first = values.get("a", ((1.0, 2.0), (3.0, 4.0)))
    first.add_(1.0)
    assert values.get("a", 0.0) is first and first.tolist() == [[2.0, 3.0], [4.0, 5.0]]
    values.freeze()
    assert values.get("a", 0.0) is first
    with pytest.raises(ValueError, match="shared value 'b' is new after construction"):
        values.get("b", 0.0)


def test_it_survives_resets_and_construction_and_belongs_to_the_state():
    env, other = (puck_env(curriculum={"counts": Counts()}) for _ in range(2))
    assert env.curriculum_levels()["counts"] == 10.0
    env.reset()
    env.reset(env_ids=[1])
    assert env.curriculum_levels()["counts"] == 14.0
    other.load_state_dict(env.state_dict())
    other.reset()
    assert other.curriculum_levels()["counts"] == 17.0


def test_two_terms_have_values_of_their_own():
    env = puck_env(curriculum={"one": Counts(), "two": Counts()})
    env.reset()
    assert [float(level) for level in env.curriculum_levels().values()] == [13.0, 13.0]


def test_without_a_curriculum_the_level_is_full():
    assert puck_env().view.level == 1.0
