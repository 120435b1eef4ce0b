"""Rough velocity tasks are the flat ones on a terrain in levels, seen by actor and critic."""

import dataclasses

import pytest
import torch

from ksim_rl import envs
from ksim_rl.mdp import HeightScan
from ksim_rl.scene.terrains import PlaneTerrain, TerrainGrid
from tests.scene.robots.reference import loaded_spec

POINTS = 17 * 11


@pytest.mark.parametrize("robot", ["go1", "g1"])
def test_it_is_the_flat_task_but_for_the_ground(robot):
    flat, rough = (envs.task(f"{robot}_velocity_{ground}").cfg() for ground in ("flat", "rough"))
    assert isinstance(flat.scene.terrain, PlaneTerrain) and isinstance(
        rough.scene.terrain, TerrainGrid
    )
    for field in (
        "actions",
        "commands",
        "rewards",
        "events",
        "metrics",
        "decimation",
        "episode_length_s",
    ):
        assert getattr(rough, field) == getattr(flat, field), field
    assert rough.scene.robots == flat.scene.robots and rough.scene.sensors == flat.scene.sensors
    for name, group in flat.observations.items():
        seen = dict(rough.observations[name].terms)
        assert isinstance(seen.pop("height_scan").term, HeightScan) and seen == group.terms
    assert dict(rough.terminations).keys() - flat.terminations.keys() == {"outside_terrain"}
    assert dict(rough.curriculum).keys() - flat.curriculum.keys() == {"terrain_level"}


def test_go1_as_in_mjlab_is_rated_along_the_ground_and_by_what_it_knocks_against():
    rough, mjlab = (envs.task(f"go1_velocity_rough{how}").cfg() for how in ("", "_mjlab"))
    assert mjlab.rewards["upright"] == dataclasses.replace(rough.rewards["upright"], along="ground")
    costs = {"self_collisions", "shank_collision", "trunk_head_collision"}
    assert dict(mjlab.rewards).keys() - rough.rewards.keys() == costs
    assert {mjlab.rewards[name].weight for name in costs} == {-0.1}
    assert set(mjlab.terminations) == {"time_out", "outside_terrain", "illegal_contact"}
    assert mjlab.terminations["illegal_contact"].threshold == 10.0
    for field in ("actions", "commands", "observations", "events", "metrics", "curriculum"):
        assert getattr(mjlab, field) == getattr(rough, field), field
    # Every geom of a shank, of the trunk and the head, and of the thighs.
    counts = {
        name: len(mjlab.scene.sensors[name].geoms)
        for name in (*costs - {"self_collisions"}, "illegal_contact")
    }
    assert counts == {"shank_collision": 8, "trunk_head_collision": 2, "illegal_contact": 12}


def test_go1_stands_on_every_kind_of_ground():
    loaded_spec(envs.task("go1_velocity_rough").cfg().scene.robots["go1"])
    calm = ["task.events.push_robot.interval_range_s=[99,99]"]
    env = envs.make("go1_velocity_rough", num_envs=10, seed=0, overrides=calm)
    view, world = env.base_env.view, env.base_env.world
    grid = env.base_env.cfg.scene.terrain
    kinds = {grid.columns[patch % grid.num_columns] for patch in view.terrain.patches_E.tolist()}
    assert kinds == set(grid.patches) and len(kinds) == 8
    view.terrain.set_levels(torch.ones(10, dtype=torch.bool), torch.full((10,), 5))
    root_E = env.reset()
    flat = envs.task("go1_velocity_flat").cfg().observations
    assert root_E["actor"].shape == (10, 48 + POINTS) and "height_scan" not in flat["actor"].terms
    for _ in range(25):
        _, root_E = env.step_and_maybe_reset(root_E.set("action", torch.zeros(10, 12)))
    height_E = view.terrain.clearance(view.root_pos_EL[:, None])[:, 0]
    assert bool(((height_E > 0.15) & (height_E < 0.35)).all())
    assert float(view.projected_gravity_EL[:, 2].max()) < -0.9
    contact = view.contact("feet_ground_contact")
    assert float(contact.found_EN.sum(-1).min()) >= 2
    # Net upward force of the ground on the feet, summed over robots: their weight, in this sign downwards.
    weight = 9.81 * float(world.mj_model.body_mass.sum())
    assert float(-contact.force_EN3[..., 2].sum(-1).mean()) == pytest.approx(weight, rel=0.25)
    report = world.overflow_report()
    assert not report.messages, report.messages
    env.close()
