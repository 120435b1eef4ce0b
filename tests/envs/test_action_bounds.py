"""Action specs have the bounds that an env's actions have, as TorchRL's and Gymnasium's parts ask for them."""

import dataclasses
import warnings

import gymnasium
import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.data import Bounded, Unbounded
from torchrl.envs.transforms import ActionDiscretizer, ActionScaling
from torchrl.envs.utils import check_env_specs
from torchrl.modules import ProbabilisticActor, TanhNormal

from ksim_rl import envs
from ksim_rl.adapters.gymnasium import GymnasiumVectorEnv
from ksim_rl.testing import count_syncs

CONTROL = (
    *(
        "cartpole_balance",
        "cartpole_swingup",
        "pendulum_swingup",
        "reacher",
        "cheetah_run",
        "hopper_stand",
    ),
    *("hopper_hop", "walker_stand", "walker_walk", "walker_run"),
)
E = 3


@pytest.fixture(scope="module")
def make():
    return lambda name="cartpole_balance": envs.make(name, num_envs=E, seed=0)


@pytest.mark.parametrize(
    "name", ["cartpole_balance", *(pytest.param(n, marks=pytest.mark.full) for n in CONTROL[1:])]
)
def test_control_tasks_take_actions_within_their_control_range(make, name):
    env = make(name)
    spec = env.full_action_spec["action"]
    assert isinstance(spec, Bounded) and spec.shape == (E, env.action_spec.shape[-1])
    assert (spec.space.low == -1.0).all() and (spec.space.high == 1.0).all()
    check_env_specs(env)


def test_positions_without_limits_have_no_bounds():
    cfg = envs.task("quadruped_velocity_flat").cfg()
    env = envs.build(dataclasses.replace(cfg, scene=dataclasses.replace(cfg.scene, num_envs=2)))
    assert isinstance(env.full_action_spec["action"], Unbounded)


@pytest.mark.parametrize("transform", [ActionScaling, lambda: ActionDiscretizer(num_intervals=5)])
def test_stock_action_transforms_take_the_control_range(make, transform):
    env = make()
    env.append_transform(transform())
    check_env_specs(env)
    assert torch.isfinite(env.rollout(4)["next", "reward"]).all()


def test_a_tanh_normal_with_the_bounds_of_the_spec_acts_within_them(make):
    env = make()
    spec = env.action_spec
    net = TensorDictModule(torch.nn.Linear(5, 2), in_keys=["actor"], out_keys=["both"])
    split = TensorDictModule(
        lambda both: (both[..., :1], both[..., 1:].exp()), ["both"], ["loc", "scale"]
    )
    policy = ProbabilisticActor(
        TensorDictSequential(net, split),
        in_keys=["loc", "scale"],
        spec=spec,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": spec.space.low, "high": spec.space.high},
    )
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("error", RuntimeWarning)
        rollout = env.rollout(5, policy)
    assert torch.isfinite(rollout["action"]).all() and (rollout["action"].abs() <= 1.0).all()


def test_gymnasium_rescales_actions_into_the_box(make):
    adapted = GymnasiumVectorEnv(make())
    assert adapted.single_action_space.low == -1.0 and adapted.single_action_space.high == 1.0
    rescaled = gymnasium.wrappers.vector.RescaleAction(adapted, min_action=-10.0, max_action=10.0)
    rescaled.reset()
    rescaled.step(rescaled.action_space.sample())


def test_a_batch_of_actions_that_are_not_finite_is_spoken_of_once(make):
    env = make()
    _, root = env.step_and_maybe_reset(env.rand_action(env.reset()))
    some = torch.tensor([[torch.nan], [0.0], [torch.inf]])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with count_syncs() as syncs:
            _, root = env.step_and_maybe_reset(root.set("action", some))
        assert not caught
        for _ in range(3):
            _, root = env.step_and_maybe_reset(root.set("action", some.fill_(torch.nan)))
    assert syncs.total == 0, syncs.report()
    (warning,) = caught
    assert (
        "no env's action is finite" in str(warning.message) and warning.category is RuntimeWarning
    )
