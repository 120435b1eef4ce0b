"""The field `transforms` of a task, from Hydra overrides to the action that the physics receives."""

import dataclasses

import pytest
import torch

from ksim_rl import envs
from ksim_rl.envs.transforms import (
    ActionDelay,
    DelayCfg,
    EpisodeTracker,
    ObservationClip,
    TransformCfg,
)

LAG = "+task.transforms.lag={_target_: ksim_rl.envs.transforms.ActionDelay, delay: {min_lag: 1, max_lag: 2}}"
COUNT = "+task.transforms.count={_target_: torchrl.envs.transforms.StepCounter, max_steps: 50}"


def names(*overrides):
    return list(envs.make_cfg("cartpole_balance", overrides).transforms)


def test_an_action_arrives_two_steps_later():
    overrides = [LAG, "task.transforms.lag.delay.min_lag=2"]
    late = envs.make("cartpole_balance", num_envs=2, seed=3, overrides=overrides)
    prompt = envs.make("cartpole_balance", num_envs=2, seed=3)
    actions = torch.linspace(-0.5, 0.5, 7).reshape(7, 1, 1).expand(7, 2, 1)
    arriving = torch.cat((torch.zeros(2, 2, 1), actions[:-2]))
    late_E, prompt_E = late.reset(), prompt.reset()
    for chosen, arrived in zip(actions, arriving, strict=True):
        late_E = late.step(late_E.set("action", chosen.clone()))
        prompt_E = prompt.step(prompt_E.set("action", arrived.clone()))
        assert torch.equal(late_E["next", "actor"], prompt_E["next", "actor"])
        assert torch.equal(late_E["action"], chosen)
        late_E, prompt_E = late_E["next"].clone(), prompt_E["next"].clone()


def test_explain_names_the_whole_chain():
    env = envs.make("cartpole_balance", num_envs=1, overrides=[LAG])
    chain = env.explain().split("transforms (")[1]
    assert (
        chain.index("(groups)")
        < chain.index("lag ")
        < chain.index("ActionDelay(delay=DelayCfg(min_lag=1, max_lag=2))")
    )


def test_overrides_add_change_and_drop_in_order():
    assert names() == []
    assert names(LAG, COUNT) == ["lag", "count"]
    assert names(LAG, COUNT, "~task.transforms.lag") == ["count"]
    assert names(LAG, COUNT, "~task.transforms.lag", LAG) == ["count", "lag"]
    cfg = envs.make_cfg("cartpole_balance", [LAG, "task.transforms.lag.delay.max_lag=3"])
    assert cfg.transforms["lag"].arguments["delay"] == DelayCfg(min_lag=1, max_lag=3)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ([LAG, "task.transforms.lga.delay.max_lag=3"], "task.transforms has no field 'lga'"),
        ([LAG, "~task.transforms.lag", "task.transforms.lag.delay.max_lag=3"], "no field 'lag'"),
        (["task.transforms.lag.delay.max_lag=3", LAG], "no field 'lag'"),
        ([LAG, "task.transforms.lag.delay.max_lgag=3"], "did you mean 'max_lag'"),
        ([LAG, "task.transforms.lag.delay.max_lag=0"], "task.transforms.lag.delay.min_lag=1 exceeds max_lag=0"),
        (["+task.transforms.lag={_target_: torchrl.envs.transforms.VIPTransform}"], "it downloads a network"),
    ],
)  # fmt: skip
def test_wrong_overrides_are_refused(overrides, message):
    with pytest.raises(ValueError, match=message):
        envs.make_cfg("cartpole_balance", overrides)


def test_a_transform_that_does_not_fit_the_env_is_named():
    cfg = envs.make_cfg("cartpole_balance", ["task.scene.num_envs=1"])
    clip = TransformCfg(ObservationClip, in_keys=["aktor"], clip=(-1.0, 1.0))
    with pytest.raises(ValueError, match="task.transforms.limits: .*'aktor'.*did you mean 'actor'"):
        envs.build(dataclasses.replace(cfg, transforms={"limits": clip}))


def test_a_stock_transform_that_reads_what_no_env_emits_is_named():
    image = "+task.transforms.image={_target_: torchrl.envs.transforms.ToTensorImage}"
    with pytest.raises(
        ValueError, match="task.transforms.image: ToTensorImage reads 'pixels': valid: .*actor"
    ):
        envs.build(envs.make_cfg("cartpole_balance", ["task.scene.num_envs=1", image]))


def test_python_gives_descriptions_rather_than_transforms():
    cfg = envs.make_cfg("cartpole_balance")
    lag = TransformCfg(ActionDelay, delay=DelayCfg(max_lag=2))
    cfg = dataclasses.replace(
        cfg, transforms={"lag": lag, "episodes": TransformCfg(EpisodeTracker)}
    )
    tree = envs.to_tree(cfg, envs.ManagerBasedRlEnvCfg)
    assert envs.from_tree(envs.ManagerBasedRlEnvCfg, tree) == cfg
    assert list(tree["transforms"]) == ["lag", "episodes"]
    with pytest.raises(ValueError, match="transforms.lag=.*expected a TransformCfg"):
        dataclasses.replace(cfg, transforms={"lag": lag.build()})
