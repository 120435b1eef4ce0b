"""G1 in the style of motions: what is compared, where episodes begin, and that a run learns from clips."""

import shutil

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl import conf
from ksim_rl.mdp.motion_observations import observe_motion
from ksim_rl.scene.motions import motion_path
from ksim_rl.tracking.tasks import ENDS, ROBOT, SET
from ksim_rl.trainers import build
from tests.tracking.g1 import g1_model

pytestmark = pytest.mark.full  # it needs the model of G1, which is large
SMALL = [
    "task=g1_style",
    "objective=amp",
    "task.sim.engine=c",
    "device=cpu",
    "logger=none",
    "num_envs=4",
    "data.num_env_states_per_minibatch=16",
    "data.num_minibatches=2",
    "objective.num_transitions_per_step=32",
    "objective.precision=float32",
    "modules.actor.hidden_dims=[8]",
    "modules.critic.hidden_dims=[8]",
    "trainer.num_threads=1",
    "trainer.eval_episodes=0",
]


@pytest.fixture(scope="module")
def trainer(tmp_path_factory):
    """A run on a folder of two clips, one of which is held out."""
    folder = tmp_path_factory.mktemp("clips")
    for name in ("g1_walk", "g1_kick"):
        shutil.copy(motion_path(name), folder)
    held_out = "task.scene.motions.clips.held_out=[g1_kick]"
    return build(conf.compose([*SMALL, f"motions={folder}", held_out]))


def test_the_style_of_a_clip_is_what_mujoco_computes_in_its_states(trainer):
    (seen_FL,) = observe_motion(trainer.collector.env, group="style", file=SET)
    with np.load(motion_path("g1_walk")) as file:
        qpos_FL = file["qpos"]
        qvel_FM = file["qvel"]
    assert len(seen_FL) == len(qpos_FL)
    model = g1_model()
    data = mujoco.MjData(model)
    num_joints = len(ROBOT.joint_names)
    frame = 200
    data.qpos[:] = qpos_FL[frame]
    data.qvel[:] = qvel_FM[frame]
    mujoco.mj_forward(model, data)
    turn_33 = np.zeros(9)
    mujoco.mju_quat2Mat(turn_33, data.qpos[3:7])
    gravity_3 = turn_33.reshape(3, 3).T @ (0.0, 0.0, -1.0)
    torso = data.body(ROBOT.torso_body)
    ends = [torso.xmat.reshape(3, 3).T @ (data.body(end).xpos - torso.xpos) for end in ENDS]
    parts = {
        "base_lin_vel": data.sensor("imu_lin_vel").data,
        "base_ang_vel": data.sensor("imu_ang_vel").data,
        "projected_gravity": gravity_3,
        "joint_pos": data.qpos[7:] - model.key_qpos[0][7:],
        "joint_vel": data.qvel[6:],
        "foot_height": [data.site(site).xpos[2] for site in ROBOT.foot_sites],
        "ends": np.concatenate(ends),
    }
    wanted_L = np.concatenate([np.asarray(part) for part in parts.values()])
    assert wanted_L.shape == (9 + 2 * num_joints + 2 + 3 * len(ENDS),)
    torch.testing.assert_close(
        seen_FL[frame], torch.tensor(wanted_L, dtype=torch.float32), rtol=1e-4, atol=1e-4
    )


def test_episodes_begin_in_states_of_clips_that_are_not_held_out(trainer):
    reference_NL = trainer.update.reference_N2L[:, 0]
    first_EL = trainer.collector.env.reset()["style"]
    # In the midst of a walk: the default pose, in which the clip begins, would be near a frame too.
    num_joints = len(ROBOT.joint_names)
    joint_vel_EL = first_EL[:, 9 + num_joints : 9 + 2 * num_joints]
    assert joint_vel_EL.abs().amax() > 1.0
    nearest_E = torch.cdist(first_EL, reference_NL).amin(-1)
    # Between two frames of a clip the nearest one is close.
    assert nearest_E.max() < 0.1 * torch.cdist(reference_NL, reference_NL).median()


def test_policy_and_discriminator_learn_from_a_few_rollouts(trainer):
    update = trainer.update
    learning = [*update.actor.parameters(), *update.discriminator.parameters()]
    before = [parameter.detach().clone() for parameter in learning]
    trainer.iterate()
    trainer.iterate()
    assert trainer.metrics["update/skipped_steps"] == 0
    assert 0.0 < trainer.metrics["style/reward"] <= 1.0
    assert not any(torch.equal(one, other) for one, other in zip(before, learning, strict=True))
