"""The action's columns, its memory, and what never reaches the controls."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ksim_rl.envs import EnvView, MjcfRobot, SceneCfg
from ksim_rl.envs.term import ActionTerm
from ksim_rl.mdp import JointEffortAction
from tests.envs.probe_env import PUCK_XML, puck_env

TWO_PUCKS = SceneCfg(
    robots={"left": MjcfRobot(source=PUCK_XML), "right": MjcfRobot(source=PUCK_XML)}, num_envs=2
)


@dataclass(frozen=True, kw_only=True)
class Idle(ActionTerm):
    """Takes three columns and does nothing."""

    def size(self, view: EnvView) -> int:
        return 3

    def __call__(self, view: EnvView, action_EK: Tensor) -> None:
        assert action_EK.shape == (view.num_envs, 3)


def pucks(**actions):
    return puck_env(scene=TWO_PUCKS, actions=actions, events={}, limit=None)


def step(env, action):
    return env.step(env.reset().set("action", torch.tensor(action)))["next"]


def test_each_term_takes_its_columns_in_the_order_of_the_config():
    right, left = (
        JointEffortAction(joints="right/rail"),
        JointEffortAction(joints="left/rail", scale=2.0),
    )
    env = pucks(right=right, idle=Idle(), left=left)
    assert env.action_spec.shape == (2, 5)
    step(env, [[1.0, 9.0, 9.0, 9.0, 2.0], [3.0, 9.0, 9.0, 9.0, 4.0]])
    assert env.world.ctrl_EL.tolist() == [[4.0, 1.0], [8.0, 3.0]], "left/push, right/push"


def test_the_action_and_the_one_before_are_remembered_and_forgotten_at_a_reset():
    env = pucks(both=JointEffortAction())
    root_E = env.reset()
    for value in (1.0, 2.0):
        root_E = env.step(root_E.set("action", torch.full((2, 2), value)))["next"].clone()
    assert env.view.action_EL.unique().tolist() == [2.0]
    assert env.view.last_action_EL.unique().tolist() == [1.0]
    env.reset(env_ids=[1])
    assert env.view.action_EL.tolist() == [[2.0, 2.0], [0.0, 0.0]]
    assert env.view.last_action_EL.tolist() == [[1.0, 1.0], [0.0, 0.0]]


def test_a_row_with_a_non_finite_entry_repeats_its_last_action():
    env = pucks(both=JointEffortAction())
    root_E = env.step(env.reset().set("action", torch.full((2, 2), 0.5)))["next"].clone()
    for bad in (torch.nan, torch.inf, -torch.inf):
        action = torch.tensor([[1.0, bad], [1.0, 2.0]])
        next_E = env.step(root_E.set("action", action))["next"].clone()
        assert env.world.ctrl_EL.isfinite().all()
        assert env.view.action_EL[0].tolist() == [0.5, 0.5] and env.view.action_EL[1].tolist() == [
            1.0,
            2.0,
        ]
        assert next_E["terminated"][:, 0].tolist() == [True, False]
        env.reset(env_ids=[0])
        root_E = env.step(next_E.set("action", torch.full((2, 2), 0.5)))["next"].clone()
