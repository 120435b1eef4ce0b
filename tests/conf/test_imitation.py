"""Distillation and AMP compose to whole configs, with what tasks set for PPO where it means the same."""

import pytest

from ksim_rl import conf
from ksim_rl.trainers import RunCfg

TEACHER = ["objective=distillation", "objective.teacher=runs/teacher"]


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
        [
            "task=hopper_hop",
            "objective=amp",
            "objective.motions=[m.npz]",
            "objective.style_group=actor",
        ]
    )
    assert ppo.data == amp.data == student.data and ppo.modules == amp.modules == student.modules
    assert amp.objective.motions == ("walker_walk",)
    for cfg in (amp, other):
        assert (cfg.objective.entropy_coeff, cfg.objective.clip_value) == (0.002, False)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["objective=distillation"], "objective.teacher='': name a run folder"),
        (
            ["task=walker_track", "objective=amp"],
            "objective.motions=.*: name at least one reference motion",
        ),
        (
            ["task=walker_track", "objective=amp", "objective.motions=[walker_walk]"],
            "no group 'style', which modules.*.in_keys or objective.style_group name",
        ),
    ],
)
def test_what_is_missing_is_said_before_anything_is_built(overrides, message):
    with pytest.raises(ValueError, match=message):
        conf.compose(overrides)
