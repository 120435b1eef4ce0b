"""Transforms described as data: checked by signature, and the same after a trip through YAML."""

import pytest
import torch
import yaml
from tensordict import TensorDict

from ksim_rl.envs import from_tree, to_tree
from ksim_rl.envs.transforms import (
    ActionDelay,
    ConstantNoise,
    DelayCfg,
    GaussianNoise,
    ObservationClip,
    ObservationNoise,
    TransformCfg,
    UniformNoise,
)
from ksim_rl.transforms import Mirror, MirrorMap

CFGS = [
    TransformCfg(ActionDelay, delay=DelayCfg(min_lag=1, max_lag=2)),
    TransformCfg(ObservationNoise, in_keys=["a", ("obs", "b")], noise=UniformNoise(low=-0.1, high=0.1)),
    TransformCfg(ObservationNoise, in_keys=["a"], noise={"a": GaussianNoise(std=0.1, bias=ConstantNoise(value=1.0))}),
    TransformCfg(ObservationNoise, in_keys=["a", "b"], noise=[GaussianNoise(std=0.1), GaussianNoise(std=0.2)]),
    TransformCfg(ObservationClip, in_keys=("obs", "b"), clip=(None, 1.0)),
    TransformCfg(Mirror, in_keys="a", maps={"a": MirrorMap(source=(1, 0)), "action": MirrorMap(source=(0,))}),
]  # fmt: skip


@pytest.mark.parametrize("cfg", CFGS, ids=str)
def test_a_description_survives_yaml(cfg):
    tree = yaml.safe_load(yaml.safe_dump(to_tree(cfg)))
    again = from_tree(TransformCfg, tree, "task.transforms.t")
    assert again == cfg
    built, expected = again.build(), cfg.build()
    assert type(built) is type(expected)
    assert (built.in_keys, built.out_keys) == (expected.in_keys, expected.out_keys)
    assert again != TransformCfg(ActionDelay, delay=DelayCfg(max_lag=7))


def test_a_nested_key_stays_one_key():
    tree = {
        "_target_": "ksim_rl.envs.transforms.ObservationClip",
        "in_keys": [["obs", "b"], "c"],
        "clip": [0, 1],
    }
    assert from_tree(TransformCfg, tree, "t").build().in_keys == [("obs", "b"), "c"]


def test_each_build_is_a_new_transform():
    assert CFGS[0].build() is not CFGS[0].build()


DELAY = "ksim_rl.envs.transforms.ActionDelay"


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        ({"delay": {"max_lag": 1}}, "^t: needs _target_"),
        ({"_target_": "os.path.join"}, "only classes of these packages.*--plugin os"),
        ({"_target_": DELAY + "ed"}, "no transform 'ActionDelayed' there: did you mean 'ActionDelay'"),
        ({"_target_": "ksim_rl.mdp.JointPos"}, "JointPos is a class, and no transform"),
        ({"_target_": DELAY, "delya": {"max_lag": 1}}, "unknown field 't.delya' of ActionDelay: did you mean 'delay'"),
        ({"_target_": DELAY}, "t: ActionDelay needs the argument 'delay'"),
        ({"_target_": DELAY, "delay": {"max_lga": 1}}, "unknown field 't.delay.max_lga' of DelayCfg"),
        ({"_target_": DELAY, "delay": {"min_lag": 3, "max_lag": 1}}, "t.delay.min_lag=3 exceeds max_lag=1"),
        ({"_target_": DELAY, "delay": {"max_lag": 1}, "initial": "zero"}, "t.initial='zero': expected float"),
        ({"_target_": "ksim_rl.transforms.ActionLowPass", "alpha": 3.0}, "t: alpha=3.0: expected"),
        ({"_target_": "ksim_rl.transforms.ObservationClip", "in_keys": [1], "clip": [0, 1]}, r"t.in_keys\[0\]=1"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named_with_its_path(tree, message):
    with pytest.raises(ValueError, match=message):
        from_tree(TransformCfg, tree, "t")


def test_python_gives_data_too():
    with pytest.raises(ValueError, match="fn=<function.*expected data"):
        TransformCfg(
            type("Own", (ActionDelay,), {"__init__": lambda self, fn: None}), fn=lambda x: x
        )
    with pytest.raises(ValueError, match="expected a class of transforms"):
        TransformCfg(CFGS[0].build())  # pyright: ignore[reportArgumentType]


def test_two_of_one_class_and_key_draw_from_streams_of_their_own():
    noise = TransformCfg(ObservationNoise, in_keys=["x"], noise=UniformNoise(low=0.0, high=1.0))
    first, second = noise.build("first"), noise.build("second")
    assert (first.stream, second.stream) == ("transforms.first", "transforms.second")
    batch = TensorDict({"x": torch.zeros(4, 3)}, batch_size=4)
    assert not bool((first(batch.clone())["x"] == second(batch.clone())["x"]).any())
    named = TransformCfg(
        ObservationNoise, in_keys=["x"], noise=UniformNoise(low=0.0, high=1.0), stream="mine"
    )
    assert named.build("first").stream == "mine"
