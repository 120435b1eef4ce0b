"""The task in which Unitree G1 follows a velocity command in the style of motions.

The reward asks for the commanded velocity and for little else. How to walk is learned from motions: `objective=amp`
(Peng et al., "AMP", arXiv 2104.02180) compares transitions of the group "style" with the transitions of the clips, and
episodes begin in their states. The policy never sees a motion, nor which one it resembles.
"""

import dataclasses
from collections.abc import Mapping

from ksim_rl import mdp
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.envs.term import ObservationTerm
from ksim_rl.modules import ActorCfg
from ksim_rl.objectives import AMPCfg
from ksim_rl.scene.motions.motion_set import MotionSet
from ksim_rl.tasks import velocity, velocity_training
from ksim_rl.tasks.velocity_flat import g1_velocity_flat
from ksim_rl.tracking.tasks import ANCHOR, ENDS, ROBOT, SET
from ksim_rl.tracking.terms import BodiesFromAnchor
from ksim_rl.trainers import TrainingCfg
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg

CLIPS = ("g1_walk", "g1_turn")
COMMANDED = (
    "track_linear_velocity",
    "track_angular_velocity",
    "dof_pos_limits",
    "action_rate_l2",
    "self_collisions",
)
"""The rewards of the velocity task that stay: the others say how to walk."""


def style() -> ObservationGroupCfg:
    """Return the group that is compared with the motions: positions and velocities alone, without noise."""
    joints = ROBOT.joint_names
    terms: Mapping[str, ObservationTerm] = {
        "base_lin_vel": mdp.SensorReading(sensor="imu_lin_vel"),
        "base_ang_vel": mdp.SensorReading(sensor="imu_ang_vel"),
        "projected_gravity": mdp.ProjectedGravity(),
        "joint_pos": mdp.JointPosRel(joints=joints),
        "joint_vel": mdp.JointVel(joints=joints),
        "foot_height": mdp.FootHeight(sites=ROBOT.foot_sites),
        "ends": BodiesFromAnchor(anchor=ANCHOR, bodies=ENDS),
    }
    return ObservationGroupCfg(
        terms={name: ObservationTermCfg(term=term) for name, term in terms.items()}
    )


def g1_style() -> ManagerBasedRlEnvCfg:
    """Return the config: the velocity task of G1 with commands and starts as in the clips, 50 Hz control."""
    # As fast as the clips are over a second, ahead, and to the left, as no clip turns right: another set has commands
    # of its own.
    command = dataclasses.replace(
        velocity.velocity_command(),
        lin_vel_x=(0.0, 0.45),
        lin_vel_y=(0.0, 0.0),
        ang_vel_z=(0.0, 0.8),
    )
    cfg = velocity.with_command(g1_velocity_flat(), command)
    events = dict(cfg.events or {})
    # A state of a clip has the root and all joints.
    del events["reset_base"], events["reset_robot_joints"]
    return dataclasses.replace(
        cfg,
        scene=dataclasses.replace(cfg.scene, motions={SET: MotionSet(sources=CLIPS)}),
        observations={**cfg.observations, "style": style()},
        events={"start": mdp.ResetToMotion(file=SET), **events},
        rewards={name: cfg.rewards[name] for name in COMMANDED},
        metrics={
            **cfg.metrics,
            "pose_distance": mdp.PoseDistance(file=SET, joints=ROBOT.joint_names),
        },
    )


def training() -> TrainingCfg:
    """Return PPO's settings for G1's velocity task, without a style."""
    return velocity_training.training(num_iterations=3_000, actor=ActorCfg(init_std=0.5))


def training_in_style() -> TrainingCfg:
    """Return the same settings, and a style that counts as much as the command.

    Both velocities together give at most 4 per second, which is 0.08 per env step.
    """
    objective = AMPCfg(
        motions=(SET,),
        task_coeff=1.0,
        style_coeff=0.08,
        gamma=0.99,
        entropy_coeff=0.005,
        precision="auto",
    )
    return dataclasses.replace(training(), objective=objective)


TASK = Task(
    name="g1_style",
    description="Unitree G1 follows a velocity command, with objective=amp in the style of many motions",
    cfg=g1_style,
    training=training(),
    other_trainings=(training_in_style(),),
)
