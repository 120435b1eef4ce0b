import math

import pytest
import torch

from ksim_rl import mdp
from ksim_rl.scene.quaternion import yaw
from ksim_rl.scene.state.ground import Ground
from tests.mdp.bench import FREE_BODY

E = 500
FIXED_ROOT = """
<mujoco><worldbody><body><joint name="hinge"/><geom size="0.1"/></body></worldbody></mujoco>
"""


@pytest.fixture
def crowd(make_bench):
    return make_bench(FREE_BODY, E, soft_joint_pos_limit_factor=0.5)


def odd_rows():
    return torch.arange(E) % 2 == 1


def test_root_starts_around_its_default_pose(crowd):
    event = mdp.ResetRootUniform(pose_range={"x": (-0.5, 0.5), "z": (0.01, 0.05), "yaw": (-3.0, 3.0)})
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
        pose_range={"yaw": (math.pi / 2, math.pi / 2)}, velocity_range={"y": (1.0, 1.0), "roll": (2.0, 2.0)}
    )
    crowd.fire(event)
    expected = torch.tensor([0.0, 1.0, 0.0, 0.0, -2.0, 0.0]).expand(E, 6)
    torch.testing.assert_close(crowd.world.qvel_EL[:, :6], expected, atol=1e-5, rtol=0)


def test_reset_leaves_other_rows_bit_identical(crowd):
    before_qpos, before_qvel = crowd.world.qpos_EL.clone(), crowd.world.qvel_EL.clone()
    mask = odd_rows()
    crowd.fire(mdp.ResetRootUniform(pose_range={"x": (1.0, 2.0)}, velocity_range={"x": (1.0, 2.0)}), mask)
    crowd.fire(mdp.ResetJoints(velocity_range=(1.0, 2.0)), mask)
    assert torch.equal(crowd.world.qpos_EL[~mask], before_qpos[~mask])
    assert torch.equal(crowd.world.qvel_EL[~mask], before_qvel[~mask])
    assert (crowd.world.qpos_EL[mask, 0] != before_qpos[mask, 0]).all()
    assert (crowd.world.qvel_EL[mask, 6:] != 0.0).all()


def test_joints_start_at_their_defaults_without_a_range(crowd):
    crowd.fire(mdp.ResetJoints())
    # The left joint's default 0.25 lies inside its soft limits (-0.5, 0.5), the right one's 0.5 on the edge.
    torch.testing.assert_close(crowd.world.qpos_EL[:, 7:], torch.tensor([0.25, 0.5]).expand(E, 2))


def test_joint_offsets_stay_in_the_soft_limits(crowd):
    crowd.fire(mdp.ResetJoints(position_range=(-2.0, 2.0), velocity_range=(-3.0, 3.0)))
    left, right = crowd.world.qpos_EL[:, 7], crowd.world.qpos_EL[:, 8]
    assert left.min() == -0.5 and left.max() == 0.5
    assert right.min() == 0.5 and right.max() == 1.5
    assert crowd.world.qvel_EL[:, 6:].abs().max() > 2.8


def test_gaussian_offsets_have_mean_and_spread(crowd):
    event = mdp.ResetJoints(velocity_range=(1.0, 0.2), joints="left_hip", distribution="gaussian")
    crowd.fire(event)
    velocity = crowd.world.qvel_EL[:, 6]
    assert abs(velocity.mean() - 1.0) < 4.0 * 0.2 / math.sqrt(E)
    assert abs(velocity.std() - 0.2) < 4.0 * 0.2 / math.sqrt(2 * E)
    assert (crowd.world.qvel_EL[:, 7] == 0.0).all()


def test_push_adds_to_the_velocity_in_the_world_frame(crowd):
    half = math.pi / 4
    crowd.place(
        qpos=(0, 0, 1, math.cos(half), 0, 0, math.sin(half), 0, 0), qvel=(0.5, 0, 0, 0.25, 0, 0, 7, 8)
    )
    before = crowd.world.qvel_EL.clone()
    mask = odd_rows()
    event = mdp.PushByVelocity(
        velocity_range={"x": (1.0, 1.0), "pitch": (2.0, 2.0)}, interval_range_s=(1.0, 3.0)
    )
    crowd.fire(event, mask)
    # A spin about world y is one about x of the body, which is turned by 90 degrees.
    kick = torch.tensor([1.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0])
    torch.testing.assert_close(crowd.world.qvel_EL[mask], before[mask] + kick, atol=1e-5, rtol=0)
    assert torch.equal(crowd.world.qvel_EL[~mask], before[~mask])


def test_two_pushes_of_one_moment_add_up(crowd):
    event = mdp.PushByVelocity(velocity_range={"yaw": (1.0, 1.0)}, interval_range_s=(1.0, 3.0))
    crowd.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0, 0))
    for scope in ("events/first", "events/second"):
        with crowd.view.scope(scope):
            event(crowd.view, crowd.everybody_E)
    torch.testing.assert_close(crowd.world.qvel_EL[:, 5], torch.full((E,), 2.0))


def test_push_needs_an_interval_and_known_axes():
    with pytest.raises(ValueError, match="interval_range_s"):
        mdp.PushByVelocity(velocity_range={})
    with pytest.raises(ValueError, match=r"velocity_range.*'jaw'.*'yaw'"):
        mdp.PushByVelocity(velocity_range={"jaw": (0.0, 1.0)}, interval_range_s=(1.0, 2.0))
    with pytest.raises(ValueError, match=r"pose_range\.x"):
        mdp.ResetRootUniform(pose_range={"x": (1.0, -1.0)})


def test_fixed_roots_are_refused(make_bench):
    bench = make_bench(FIXED_ROOT, 2)
    with pytest.raises(ValueError, match="ResetRootUniform needs a robot whose first joint is free"):
        bench.fire(mdp.ResetRootUniform())


def test_on_a_terrain_the_default_pose_stands_at_the_envs_origin(crowd):
    class Hill(Ground):
        """Ground on which envs start at (5, -3, 0.5)."""

        is_flat = False

        @property
        def origins_E3(self):
            return torch.tensor([5.0, -3.0, 0.5]).expand(E, 3)

    crowd.view.terrain = Hill(E, crowd.view.device)
    crowd.fire(mdp.ResetRootUniform(pose_range={"z": (0.1, 0.1)}))
    torch.testing.assert_close(crowd.world.qpos_EL[:, :3], torch.tensor([6.0, -1.0, 3.6]).expand(E, 3))
