"""TorchRL's own transforms in configs: the written list is complete, and each class works in an env."""

import pytest
import torch
import torchrl.envs.transforms as torchrl_transforms
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Compose, Transform

from ksim_rl.envs import MaskedTransformedEnv, from_tree
from ksim_rl.envs.transforms import TransformCfg
from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import stock

IMAGES = {"in_keys": ["rgb"]}
ARGUMENTS = {
    "ActionDiscretizer": {"num_intervals": 4},
    "ActionMask": {},
    "ActionScaling": {"loc": 0.0, "scale": 2.0},
    "CatFrames": {"N": 3, "dim": -1, "in_keys": ["count"]},
    "CatTensors": {"in_keys": ["count"], "out_key": "all", "del_keys": False},
    "ClipTransform": {"in_keys": ["count"], "low": -1.0, "high": 1.0},
    "DiscreteActionProjection": {"num_actions_effective": 2, "max_actions": 3},
    "ExpandAs": {"in_key": "reward", "ref_key": "count", "out_key": "wide"},
    "FlattenAction": {"first_dim": -2, "last_dim": -1},
    "FlattenObservation": {"first_dim": -2, "last_dim": -1, **IMAGES},
    "GrayScale": IMAGES,
    "LineariseRewards": {"in_keys": ["reward"], "weights": [2.0]},
    "ObservationNorm": {"loc": 0.5, "scale": 2.0, "in_keys": ["count"]},
    "PermuteTransform": {"dims": [-1, -2], **IMAGES},
    "RenameTransform": {"in_keys": ["count"], "out_keys": ["seen"]},
    "RewardClipping": {"clamp_min": -1.0, "clamp_max": 1.0},
    "RewardScaling": {"loc": 0.0, "scale": 0.1},
    "SignTransform": {"in_keys": ["reward"]},
    "SqueezeTransform": {"dim": -1, **IMAGES},
    "Stack": {"in_keys": ["count"], "out_key": "stacked"},
    "StepCounter": {"max_steps": 5},
    "SuccessReward": {"success_key": "count"},
    "TargetReturn": {"target_return": 10.0},
    "TimeMaxPool": {"in_keys": ["count"], "T": 2},
    "ToTensorImage": IMAGES,
    "UnsqueezeTransform": {"dim": -1, "in_keys": ["count"]},
}
# Those that need images, discrete actions or several action dims only have to be built.
NEEDS_ANOTHER_ENV = {name for name, given in ARGUMENTS.items() if "rgb" in given.get("in_keys", ())} | {
    "ActionMask", "ActionScaling", "ActionDiscretizer", "DiscreteActionProjection", "FlattenAction", "LineariseRewards",
    "BinarizeReward", "SuccessReward",
}  # fmt: skip


def described(name):
    tree = {"_target_": f"torchrl.envs.transforms.{name}", **ARGUMENTS.get(name, {})}
    return from_tree(TransformCfg, tree, "t")


def test_each_name_of_torchrl_is_in_one_of_the_two_tables():
    listed = [*stock.DATA, *stock.REFUSED]
    assert len(listed) == len(set(listed))
    assert set(listed) == set(torchrl_transforms.__all__)


@pytest.mark.parametrize("name", stock.DATA)
def test_each_listed_one_is_built_from_data(name):
    assert type(described(name).build()) is getattr(torchrl_transforms, name)


def test_those_of_images_step_as_in_torchrl():
    chain = [described(name) for name in ("ToTensorImage", "GrayScale")]
    ours, theirs = (
        wrapper(CounterEnv(picture=(4, 6, 3)), Compose(*(cfg.build() for cfg in chain)))
        for wrapper in (MaskedTransformedEnv, TransformedEnv)
    )
    a, b = (env.rollout(8, break_when_any_done=False)["next", "rgb"] for env in (ours, theirs))
    assert a.shape[2:] == (1, 4, 6) and torch.equal(a, b)


@pytest.mark.parametrize("name", sorted(set(stock.DATA) - NEEDS_ANOTHER_ENV))
def test_each_listed_one_steps_as_in_torchrl(name):
    ours = MaskedTransformedEnv(CounterEnv(), described(name).build())
    theirs = TransformedEnv(CounterEnv(), described(name).build())
    policy = ours.rand_action
    torch.manual_seed(0)
    a = ours.rollout(8, policy, break_when_any_done=False)
    torch.manual_seed(0)
    b = theirs.rollout(8, theirs.rand_action, break_when_any_done=False)
    for key in b.keys(True, True):
        assert torch.equal(a[key], b[key]), key


@pytest.mark.parametrize(
    "name", [n for n in stock.REFUSED if issubclass(getattr(torchrl_transforms, n), Transform)]
)
def test_the_others_are_refused_with_the_reason(name):
    with pytest.raises(ValueError, match="cannot be part of a config") as error:
        from_tree(TransformCfg, {"_target_": f"torchrl.envs.transforms.{name}"}, "t")
    assert stock.REFUSED[name] in str(error.value)
