"""Distillation and AMP compose to whole configs, with what tasks set for PPO where it means the same."""

from importlib.resources import files

import pytest
from omegaconf import OmegaConf

from ksim_rl import conf
from ksim_rl.envs import to_tree
from ksim_rl.objectives import AMPCfg, DistillationCfg, PPOCfg
from ksim_rl.trainers import RunCfg

FOLDER = files("ksim_rl.conf") / "objective"
TEACHER = ["objective=distillation", "objective.teacher=runs/teacher"]


def read(name):
    tree = OmegaConf.to_container(OmegaConf.create((FOLDER / name).read_text()))
    tree.pop("defaults", None)
    target = tree.pop("_target_")
    return target, tree


def test_the_yaml_files_list_every_field_with_its_default():
    target, tree = read("distillation.yaml")
    assert target == "ksim_rl.objectives.DistillationCfg"
    assert tree | {"teacher": "x"} == to_tree(DistillationCfg(teacher="x"), DistillationCfg)
    target, tree = read("amp.yaml")
    assert target == "ksim_rl.objectives.AMPCfg"
    # The rest is in ppo.yaml, on which it builds.
    cfg = to_tree(AMPCfg(motions=("x",)), AMPCfg)
    assert tree | {"motions": ["x"]} == {
        key: value for key, value in cfg.items() if key not in to_tree(PPOCfg(), PPOCfg)
    }


@pytest.mark.parametrize(
    "overrides",
    [
        ["task=walker_amp", "objective=amp"],
        ["task=walker_track", *TEACHER],
        ["task=hopper_hop", *TEACHER, "modules=gru"],
    ],
)
def test_each_composes_and_round_trips(overrides):
    cfg = conf.compose(overrides)
    assert RunCfg.from_tree(cfg.to_tree()) == cfg


def test_settings_of_ppo_hold_for_amp_wholly_and_for_a_student_in_data_and_networks():
    ppo = conf.compose(["task=walker_amp"])
    amp = conf.compose(["task=walker_amp", "objective=amp"])
    student = conf.compose(["task=walker_amp", *TEACHER])
    other = conf.compose(
        ["task=hopper_hop", "objective=amp", "objective.motions=[m.npz]", "objective.style_group=actor"]
    )
    assert ppo.data == amp.data == student.data and ppo.modules == amp.modules == student.modules
    assert amp.objective.motions == ("walker_walk",)
    for cfg in (amp, other):
        assert (cfg.objective.entropy_coeff, cfg.objective.clip_value) == (0.002, False)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["objective=distillation"], "objective.teacher='': name a run folder"),
        (["task=walker_track", "objective=amp"], "objective.motions=.*: name at least one reference motion"),
        (
            ["task=walker_track", "objective=amp", "objective.motions=[walker_walk]"],
            "no group 'style', which modules.*.in_keys or objective.style_group name",
        ),
    ],
)
def test_what_is_missing_is_said_before_anything_is_built(overrides, message):
    with pytest.raises(ValueError, match=message):
        conf.compose(overrides)
