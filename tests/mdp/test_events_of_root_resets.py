import math

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl import mdp
from ksim_rl.envs import (
    ManagerBasedRlEnv,
    MjcfRobot,
    ObservationGroupCfg,
    ObservationTermCfg,
    SceneCfg,
)
from ksim_rl.scene.quaternion import yaw
from ksim_rl.scene.state.ground import Ground
from tests.envs.probe_env import puck_cfg
from tests.mdp.bench import FREE_BODY, Plateau

E = 500
FIXED_ROOT = """
<mujoco><worldbody><body><joint name="hinge"/><geom size="0.1"/></body></worldbody></mujoco>
"""


def odd_rows():
    return torch.arange(E) % 2 == 1


def trunk_axes(crowd):
    """Return the trunk's rotation matrix in each row, as the C engine has it, [E, 3, 3]."""
    model = mujoco.MjModel.from_xml_string(FREE_BODY)
    data, axes = mujoco.MjData(model), []
    for qpos in crowd.world.qpos_EL:
        data.qpos[:] = qpos.numpy()
        mujoco.mj_kinematics(model, data)
        axes.append(data.body("trunk").xmat.reshape(3, 3).copy())
    return np.stack(axes)


def test_root_starts_around_its_default_pose(crowd):
    event = mdp.ResetRootUniform(
        pose_range={"x": (-0.5, 0.5), "z": (0.01, 0.05), "yaw": (-3.0, 3.0)}
    )
    crowd.fire(event)
    offset = crowd.world.qpos_EL[:, :3] - torch.tensor([1.0, 2.0, 3.0])
    assert offset[:, 0].min() < -0.45 and offset[:, 0].max() > 0.45
    assert (offset[:, 1] == 0.0).all()
    assert offset[:, 2].min() >= 0.01 - 1e-6 and offset[:, 2].max() <= 0.05 + 1e-6
    angle = yaw(crowd.world.qpos_EL[:, 3:7])
    assert angle.min() < -2.8 and angle.max() > 2.8
    torch.testing.assert_close(crowd.view.projected_gravity_EL[:, 2], torch.full((E,), -1.0))
    assert (crowd.world.qvel_EL[:, :6] == 0.0).all()


def test_reset_velocity_is_in_the_world_frame(crowd):
    # Turned by 90 degrees of yaw, a spin about world x is one about minus y of the body.
    event = mdp.ResetRootUniform(
        pose_range={"yaw": (math.pi / 2, math.pi / 2)},
        velocity_range={"y": (1.0, 1.0), "roll": (2.0, 2.0)},
    )
    crowd.fire(event)
    expected = torch.tensor([0.0, 1.0, 0.0, 0.0, -2.0, 0.0]).expand(E, 6)
    torch.testing.assert_close(crowd.world.qvel_EL[:, :6], expected, atol=1e-5, rtol=0)


def test_reset_leaves_other_rows_bit_identical(crowd):
    before_qpos, before_qvel = crowd.world.qpos_EL.clone(), crowd.world.qvel_EL.clone()
    mask = odd_rows()
    crowd.fire(
        mdp.ResetRootUniform(pose_range={"x": (1.0, 2.0)}, velocity_range={"x": (1.0, 2.0)}), mask
    )
    crowd.fire(mdp.ResetJoints(velocity_range=(1.0, 2.0)), mask)
    assert torch.equal(crowd.world.qpos_EL[~mask], before_qpos[~mask])
    assert torch.equal(crowd.world.qvel_EL[~mask], before_qvel[~mask])
    assert (crowd.world.qpos_EL[mask, 0] != before_qpos[mask, 0]).all()
    assert (crowd.world.qvel_EL[mask, 6:] != 0.0).all()


def test_fixed_roots_are_refused(make_bench):
    bench = make_bench(FIXED_ROOT, 2)
    with pytest.raises(
        ValueError, match="write_root_pose of 'robot': .* needs a robot or object whose first"
    ):
        bench.fire(mdp.ResetRootUniform())


def test_on_a_terrain_the_default_pose_stands_at_the_envs_origin(crowd):
    class Hill(Ground):
        """Ground on which envs start at (5, -3, 0.5)."""

        is_flat = False

        @property
        def origins_E3(self):
            return torch.tensor([5.0, -3.0, 0.5]).expand(E, 3)

    crowd.driver.ground = Hill(E, crowd.view.device)
    crowd.fire(mdp.ResetRootUniform(pose_range={"z": (0.1, 0.1)}))
    torch.testing.assert_close(
        crowd.world.qpos_EL[:, :3], torch.tensor([6.0, -1.0, 3.6]).expand(E, 3)
    )


def test_the_heading_is_the_drawn_one_and_the_tilt_stays(crowd):
    tilt = 0.6
    crowd.place(qpos=(0.1, 0.2, 1, math.cos(tilt / 2), math.sin(tilt / 2), 0, 0, 0, 0))
    before = crowd.world.qpos_EL.clone()
    crowd.fire(mdp.ResetHeading(heading_range=(0.5, 2.5)), odd_rows())
    assert torch.equal(crowd.world.qpos_EL[~odd_rows()], before[~odd_rows()])
    assert torch.equal(crowd.world.qpos_EL[:, :3], before[:, :3])
    axes = trunk_axes(crowd)[1::2]
    headings = np.arctan2(axes[:, 1, 0], axes[:, 0, 0])
    assert headings.min() >= 0.5 - 1e-4 and headings.max() <= 2.5 + 1e-4 and headings.std() > 0.5
    np.testing.assert_allclose(np.arccos(axes[:, 2, 2]), tilt, atol=1e-3)


def test_the_height_is_above_the_ground(crowd):
    crowd.place(qpos=(0.1, 0.2, 9.0, 1, 0, 0, 0, 0, 0))
    crowd.fire(mdp.ResetHeight(height_range=(0.3, 0.4)), odd_rows())
    heights_E = crowd.world.qpos_EL[:, 2]
    assert (heights_E[~odd_rows()] == 9.0).all()
    assert heights_E[odd_rows()].min() >= 0.3 - 1e-5 and heights_E[odd_rows()].max() <= 0.4 + 1e-5
    flat, crowd.driver.ground = crowd.view.terrain, Plateau(E, crowd.view.device)
    crowd.fire(mdp.ResetHeight(height_range=(0.3, 0.3)))
    crowd.driver.ground = flat
    torch.testing.assert_close(crowd.world.qpos_EL[:, 2], torch.full((E,), 0.55))


def test_they_may_follow_one_another_in_one_reset(crowd):
    with crowd.driver.scope("events/root"):
        mdp.ResetRootUniform(pose_range={"roll": (0.3, 0.3)})(crowd.view, crowd.everybody_E)
    with crowd.driver.scope("events/height"):
        mdp.ResetHeight(height_range=(2.0, 2.0))(crowd.view, crowd.everybody_E)
    crowd.fire(mdp.ResetHeading(heading_range=(1.0, 1.0)))
    torch.testing.assert_close(
        crowd.world.qpos_EL[:, :3], torch.tensor([1.0, 2.0, 2.0]).expand(E, 3)
    )
    torch.testing.assert_close(crowd.view.heading_E, torch.ones(E))
    torch.testing.assert_close(
        crowd.view.projected_gravity_EL[:, 2], torch.full((E,), -math.cos(0.3))
    )


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: mdp.ResetRootUniform(pose_range={"x": (1.0, -1.0)}), r"pose_range\.x"),
        (lambda: mdp.ResetHeading(heading_range=(0.0, math.nan)), r"heading_range\[1\]"),
        (lambda: mdp.ResetHeight(height_range=(1.0, 0.5)), "height_range"),
    ],
)
def test_what_does_not_fit_is_refused(make, field):
    with pytest.raises(ValueError, match=field):
        make()


def moving_env(share, **events):
    velocity = {
        "v": ObservationTermCfg(term=mdp.RootLinVel()),
        "w": ObservationTermCfg(term=mdp.RootAngVel()),
    }
    command = mdp.UniformVelocityCommand(
        lin_vel_x=(0.5, 1.0),
        lin_vel_y=(-0.5, 0.5),
        ang_vel_z=(-1.0, 1.0),
        resampling_time_range_s=None,
    )
    return ManagerBasedRlEnv(
        puck_cfg(
            scene=SceneCfg(robots={"body": MjcfRobot(source=FREE_BODY)}, num_envs=200),
            observations={"actor": ObservationGroupCfg(terms=velocity)},
            actions={"legs": mdp.JointEffortAction(joints="left_hip")},
            commands={"twist": command},
            events={
                "root": mdp.ResetRootUniform(pose_range={"yaw": (-3.0, 3.0), "roll": (-0.5, 0.5)}),
                "start": mdp.StartAtCommand(command="twist", share=share),
                **events,
            },
            rewards={},
            limit=None,
        )
    )


def test_some_episodes_start_at_the_commanded_speed():
    env = moving_env(0.3)
    root_E = env.reset()
    command_E3, v_E3, w_E3 = root_E["command", "twist"], root_E["obs", "v"], root_E["obs", "w"]
    moves_E = v_E3.abs().sum(-1) > 0.0
    assert abs(moves_E.float().mean() - 0.3) < 4.0 * math.sqrt(0.21 / 200)
    # In the root's own frame, however it lies: what the observation of the new episode shows.
    torch.testing.assert_close(v_E3[moves_E, :2], command_E3[moves_E, :2], atol=1e-5, rtol=0)
    torch.testing.assert_close(w_E3[moves_E, 2], command_E3[moves_E, 2], atol=1e-5, rtol=0)
    rest = torch.cat((v_E3[:, 2:], w_E3[:, :2]), dim=-1)
    torch.testing.assert_close(rest, torch.zeros(200, 3), atol=1e-5, rtol=0)
    assert (w_E3[~moves_E] == 0.0).all()
    # Rows that do not reset stay as they are.
    before = env.world.qvel_EL.clone()
    env.reset(env_ids=[0, 1])
    assert torch.equal(env.world.qvel_EL[2:], before[2:]) and not torch.equal(
        env.world.qvel_EL[:2], before[:2]
    )


def test_a_start_at_the_command_has_its_mode():
    with pytest.raises(ValueError, match="mode='reset': expected 'start'"):
        mdp.StartAtCommand(command="twist", mode="reset")
