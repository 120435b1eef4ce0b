"""Motions with boxes: the robot can do them, stands and sits on the box, and nothing runs into it."""

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl import envs
from ksim_rl.scene.motions.motion import motion_path
from ksim_rl.scene.robots.unitree_g1 import UnitreeG1
from ksim_rl.scene.terrains import PlaneWithBoxes
from ksim_rl.tracking.g1_boxes import BOX_CLIPS, SEAT, STEP, made, step_box
from ksim_rl.tracking.g1_motions import FIGURE, FPS
from ksim_rl.tracking.keyframes import foot_paths
from tests.tracking.g1 import g1_model


def frames(name):
    """Yield the data of each frame, in a model of the robot on the clip's ground."""
    g1_model()
    spec = UnitreeG1().spec()
    PlaneWithBoxes(boxes=(BOX_CLIPS[name].box,)).add_to(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    with np.load(motion_path(name)) as file:
        assert float(file["fps"]) == FPS
        for qpos in file["qpos"]:
            data.qpos[:] = qpos
            mujoco.mj_fwdPosition(model, data)
            yield model, data


@pytest.mark.parametrize("name", BOX_CLIPS)
def test_nothing_runs_into_the_ground_or_the_box(name):
    deepest = {}
    for model, data in frames(name):
        for contact in data.contact[: data.ncon]:
            pair = [model.geom(int(geom)).name for geom in contact.geom]
            ground = [geom for geom in pair if geom.startswith("terrain")]
            if ground:
                deepest[ground[0]] = min(deepest.get(ground[0], 0.0), float(contact.dist))
    assert all(distance > -3e-3 for distance in deepest.values()), deepest


def test_feet_stand_on_the_step_and_then_on_the_ground_again():
    plan = step_box()
    soles = [[data.site(foot).xpos[2] for foot in FIGURE.feet] for _, data in frames("g1_step")]
    soles_FN = np.array(soles) - FIGURE.sole_z
    paths_FN5, planted_FN = foot_paths(plan, np.arange(len(soles_FN)) / FPS)
    assert np.abs(soles_FN - paths_FN5[..., 2])[planted_FN].max() < 1e-3
    on_top = planted_FN & (np.abs(soles_FN - STEP.size[2]) < 1e-3)
    assert on_top.all(1).sum() > 0.5 * FPS and planted_FN.any(1).all()
    assert soles_FN[[0, -1]] == pytest.approx(0.0, abs=1e-3)
    # Soles lie inside of the step, heels and toes.
    places = [[data.site(foot).xpos[0] for foot in FIGURE.feet] for _, data in frames("g1_step")]
    begin, end = STEP.pos[0] - STEP.size[0] / 2, STEP.pos[0] + STEP.size[0] / 2
    x_N = np.array(places)[on_top]
    assert x_N.min() - 0.094 > begin and x_N.max() + 0.094 < end


def test_pelvis_and_hips_come_down_to_the_seat():
    gaps = []
    for model, data in frames("g1_sit"):
        lowest = []
        for geom in range(model.ngeom):
            if model.geom(geom).name in ("pelvis_collision", "left_hip_collision"):
                reach = abs(data.geom_xmat[geom].reshape(3, 3)[2, 2]) * model.geom_size[geom, 1]
                lowest.append(data.geom_xpos[geom, 2] - model.geom_size[geom, 0] - reach)
        gaps.append(min(lowest) - SEAT.size[2])
    # For a second and a half, within a centimetre.
    assert (np.abs(gaps) < 0.01).sum() >= 1.5 * FPS and gaps[0] > 0.2 and gaps[-1] > 0.2


@pytest.mark.full
@pytest.mark.parametrize("name", BOX_CLIPS)
def test_a_clip_is_feasible_and_made_again(name):
    g1_model()
    qpos_FL, found = made(name)
    assert found.faults() == []
    with np.load(motion_path(name)) as file:
        assert file["qpos"] == pytest.approx(qpos_FL, abs=1e-4)


@pytest.mark.full
@pytest.mark.parametrize(("name", "box"), [("g1_track_step", STEP), ("g1_track_sit", SEAT)])
def test_the_scene_has_the_box_and_the_robot_starts_beside_it(name, box):
    g1_model()
    env = envs.make(name, num_envs=2, seed=0, overrides=["task.sim.engine=c"])
    root_E = env.reset()
    for _ in range(20):
        root_E = env.step_and_maybe_reset(root_E.set("action", torch.zeros(2, 29)))[1]
    world = env.base_env.world
    geom = world.mj_model.geom("terrain_box0")
    assert list(2 * geom.size) == pytest.approx(box.size)
    height = env.base_env.view.terrain.heights(torch.tensor([[[*box.pos], [5.0, 5.0]]] * 2))
    assert height.tolist() == [pytest.approx([box.size[2], 0.0])] * 2
    env.close()


def test_pressure_is_under_the_soles_at_the_height_on_which_they_stand():
    com, push, spin, soles = [], [], [], []
    with np.load(motion_path("g1_step")) as file:
        qvel_FM = file["qvel"].astype(float)
    for (model, data), qvel in zip(frames("g1_step"), qvel_FM, strict=True):
        data.qvel[:] = qvel
        mujoco.mj_comVel(model, data)
        mujoco.mj_subtreeVel(model, data)
        com.append(data.subtree_com[0].copy())
        push.append(float(model.body_subtreemass[1]) * data.subtree_linvel[0])
        spin.append(data.subtree_angmom[0].copy())
        soles.append([data.site(foot).xpos.copy() for foot in FIGURE.feet])
    force_F3, moment_F3 = (np.gradient(np.array(part), 1 / FPS, axis=0) for part in (push, spin))
    force_F3[:, 2] += float(model.body_subtreemass[1]) * 9.81
    com_F3, soles_FN3 = np.array(com), np.array(soles)
    _, planted_FN = foot_paths(step_box(), np.arange(len(com_F3)) / FPS)
    outside = []
    # The left foot stands alone on the step, the right one on the ground.
    for foot, height in ((0, STEP.size[2]), (1, 0.0)):
        alone_F = planted_FN[:, foot] & ~planted_FN[:, 1 - foot]
        place_F3 = soles_FN3[alone_F, foot]
        assert place_F3[:, 2] - FIGURE.sole_z == pytest.approx(height, abs=1e-3)
        # The point at the height of the sole about which the ground's force has no horizontal moment.
        lever_F = com_F3[alone_F, 2] - (place_F3[:, 2] - FIGURE.sole_z)
        force, moment = force_F3[alone_F], moment_F3[alone_F]
        x_F = com_F3[alone_F, 0] - (lever_F * force[:, 0] + moment[:, 1]) / force[:, 2]
        y_F = com_F3[alone_F, 1] - (lever_F * force[:, 1] - moment[:, 0]) / force[:, 2]
        outside += [*(np.abs(x_F - place_F3[:, 0]) - 0.09), *(np.abs(y_F - place_F3[:, 1]) - 0.025)]
    assert max(outside) < 0.0
