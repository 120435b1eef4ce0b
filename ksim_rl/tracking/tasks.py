"""The tasks in which Unitree G1 follows the motions of `g1_motions` with its whole body.

Observations, noise, rewards, limits, pushes and randomization follow mjlab's tracking task for G1
(src/mjlab/tasks/tracking at its commit 0eda4e7), so that both can be compared on the same work. Four things differ:
actions move the servos' targets about the motion, where mjlab's move them about the default pose; an episode ends (as a
truncation) with the motion, where mjlab's goes on at another place of it; self-contact counts in each physics substep,
with a quarter of the weight; and half of the starts are spread evenly.
"""

import dataclasses
from collections.abc import Callable
from functools import partial

from ksim_rl import mdp
from ksim_rl.data import DatasetCfg
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.envs.term import EventTerm, RewardTerm
from ksim_rl.modules import ActorCfg
from ksim_rl.objectives import PPOCfg
from ksim_rl.scene.motions.motion_set import MotionSet
from ksim_rl.scene.robots.unitree_g1 import SIDES, UnitreeG1
from ksim_rl.scene.terrains import PlaneWithBoxes
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.tasks import velocity, velocity_training
from ksim_rl.tasks.velocity import noisy
from ksim_rl.tracking import terms
from ksim_rl.tracking.assistance import AssistRoot, assisted
from ksim_rl.tracking.g1_boxes import BOX_CLIPS
from ksim_rl.tracking.starts import FailedParts, StartInMotion
from ksim_rl.trainers import ModulesCfg, TrainerCfg, TrainingCfg
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg

ROBOT = UnitreeG1()
ANCHOR = ROBOT.torso_body
BODIES = (
    "pelvis",
    *(
        f"{side}_{link}_link"
        for side in SIDES
        for link in ("hip_roll", "knee", "ankle_roll", "shoulder_roll", "elbow", "wrist_yaw")
    ),
    ANCHOR,
)
ENDS = tuple(f"{side}_{link}_link" for side in SIDES for link in ("ankle_roll", "wrist_yaw"))
"""Feet and hands."""
HEIGHT_LIMIT = 0.25
UPRIGHT_LIMIT = 0.8
"""m, of the anchor and of feet and hands; and the difference of the vertical parts of the anchors' z axes."""
KICK: mdp.Ranges = {
    "x": (-0.5, 0.5),
    "y": (-0.5, 0.5),
    "z": (-0.2, 0.2),
    "roll": (-0.52, 0.52),
    "pitch": (-0.52, 0.52),
    "yaw": (-0.78, 0.78),
}
"""m/s and rad/s, of pushes and of the errors that episodes begin with."""
PART_S = 1.0
SET = "clips"
"""The name of the set of motions in the config of `g1_track`: `task.scene.motions.clips`."""
AHEAD_S = (0.0, 0.1, 0.3)
"""s from now, of the motion's joints that a policy of many motions sees."""
ENV_STATES_PER_ITERATION = 24 * 4096
# 160 million env states, after which G1 followed each of the four motions in all of 1024 trials.
ITERATIONS = 1_627


def observations(
    file: str, *, ahead_s: float | tuple[float, ...] = 0.0
) -> dict[str, ObservationGroupCfg]:
    """Return the groups: a noisy "actor", and a clean "critic" that also sees where the bodies are.

    `ahead_s` are the moments of the motion that both see, s from now.
    """
    # Order of the robot, which observations and actions share.
    joints = ROBOT.joint_names
    motion = mdp.MotionJoints(file=file, joints=joints, ahead_s=ahead_s)
    reference = {"reference": ObservationTermCfg(term=motion)}
    last = {"actions": ObservationTermCfg(term=mdp.LastAction())}
    # Term and reach of its uniform noise, in the term's units, about as good as the robot's sensors.
    reaches = {
        "anchor_pos": (terms.MotionAnchorPos(file=file, anchor=ANCHOR), 0.25),
        "anchor_axes": (terms.MotionAnchorAxes(file=file, anchor=ANCHOR), 0.05),
        "base_lin_vel": (mdp.SensorReading(sensor="imu_lin_vel"), 0.5),
        "base_ang_vel": (mdp.SensorReading(sensor="imu_ang_vel"), 0.2),
        "joint_pos": (mdp.JointPosRel(joints=joints), 0.01),
        "joint_vel": (mdp.JointVel(joints=joints), 0.5),
    }
    bodies = {
        f"body_{part}": ObservationTermCfg(
            term=terms.BodiesFromAnchor(anchor=ANCHOR, bodies=BODIES, part=part)
        )
        for part in ("positions", "axes")
    }
    # The critic sees the same terms without noise.
    clean = {name: ObservationTermCfg(term=term) for name, (term, _) in reaches.items()}
    seen = {name: noisy(term, reach) for name, (term, reach) in reaches.items()}
    return {
        "actor": ObservationGroupCfg(terms={**reference, **seen, **last}),
        "critic": ObservationGroupCfg(terms={**reference, **clean, **last, **bodies}),
    }


def rewards(file: str) -> dict[str, RewardTerm]:
    """Return the rewards: how near anchor and bodies are to the motion, and costs of rough and unsafe motion."""
    anchor = {"file": file, "anchor": ANCHOR}
    aligned = {**anchor, "bodies": BODIES}
    bodies = {"file": file, "bodies": BODIES}
    return {
        # Weights and stds of mjlab.
        "anchor_pos": terms.TrackAnchorPos(weight=0.5, std=0.3, **anchor),
        "anchor_quat": terms.TrackAnchorQuat(weight=0.5, std=0.4, **anchor),
        "body_pos": terms.TrackAlignedPos(weight=1.0, std=0.3, **aligned),
        "body_quat": terms.TrackAlignedQuat(weight=1.0, std=0.4, **aligned),
        "body_lin_vel": terms.TrackBodyLinVel(weight=1.0, std=1.0, **bodies),
        "body_ang_vel": terms.TrackBodyAngVel(weight=1.0, std=3.14, **bodies),
        "action_rate_l2": mdp.ActionRateL2(weight=-0.1),
        "dof_pos_limits": mdp.JointPosLimits(weight=-10.0),
        "self_collisions": mdp.SelfCollision(weight=-2.5, sensor=velocity.SELF),
    }


def events(file: str) -> dict[str, EventTerm]:
    """Return starts with errors, pushes, and draws for each world: mass centre, default pose, friction."""
    return {
        # Errors at the start in m and rad, so that the policy learns to recover.
        "start": StartInMotion(
            file=file,
            pose_range={
                **dict.fromkeys(("x", "y"), (-0.05, 0.05)),
                "z": (-0.01, 0.01),
                **dict.fromkeys(("roll", "pitch"), (-0.1, 0.1)),
                "yaw": (-0.2, 0.2),
            },
            velocity_range=KICK,
            joint_range=0.1,
            part_s=PART_S,
        ),
        "push_robot": mdp.PushByVelocity(interval_range_s=(1.0, 3.0), velocity_range=KICK),
        "base_com": mdp.RandomizeBodyCom(
            bodies=ANCHOR,
            operation="add",
            # Axes x, y and z of the torso, m.
            ranges={0: (-0.025, 0.025), 1: (-0.05, 0.05), 2: (-0.05, 0.05)},
        ),
        # Joint encoders are off by a constant.
        "default_pose": mdp.RandomizeDefaultJointPos(ranges=(-0.01, 0.01)),
        "foot_friction": velocity.foot_friction(ROBOT, low=0.3, high=1.2),
    }


def track_cfg(file: str) -> ManagerBasedRlEnvCfg:
    """Return the config of following a motion of G1, a file or one that comes with the package; 50 Hz control."""
    return ManagerBasedRlEnvCfg(
        decimation=4,
        # A robot that lies on its arms needs 221 rows, more than the probe of the model finds.
        sim=dataclasses.replace(velocity.sim(), njmax=256),
        scene=velocity.on_plane(ROBOT, velocity.self_contact(ROBOT)),
        observations=observations(file),
        actions={
            "joint_pos": terms.JointPositionAroundMotion(
                file=file, joints=ROBOT.joint_names, scale=ROBOT.action_scale
            )
        },
        rewards=rewards(file),
        events=events(file),
        terminations={
            # The end of the motion is no failure; the others are, and the curriculum counts them.
            "finished": mdp.MotionFinished(file=file),
            "anchor_height": terms.OffHeight(file=file, bodies=ANCHOR, distance=HEIGHT_LIMIT),
            "anchor_upright": terms.OffUpright(file=file, anchor=ANCHOR, limit=UPRIGHT_LIMIT),
            "ends_height": terms.OffHeight(file=file, bodies=ENDS, distance=HEIGHT_LIMIT),
        },
        curriculum={"failed_parts": FailedParts(file=file, part_s=PART_S)},
        metrics={
            "body_pos_error": terms.BodyPosError(file=file, anchor=ANCHOR, bodies=BODIES),
            "body_drift": terms.BodyDrift(file=file, bodies=BODIES),
        },
        episode_length_s=10.0,
        viewer=ViewerCfg(body=ANCHOR, distance=3.0, elevation=-10.0, azimuth=90.0),
    )


def on_box_cfg(name: str) -> ManagerBasedRlEnvCfg:
    """Return the config of following a motion of `BOX_CLIPS`, in a scene that has its box."""
    cfg = track_cfg(name)
    ground = PlaneWithBoxes(boxes=(BOX_CLIPS[name].box,))
    return dataclasses.replace(cfg, scene=dataclasses.replace(cfg.scene, terrain=ground))


def assisted_cfg() -> ManagerBasedRlEnvCfg:
    """Return the config of `g1_track` with help at the pelvis, of 60 % of the weight at most, that is withdrawn.

    The help is whole for the first 6,000 env steps, and gone after 24,000.
    """
    cfg = track_set_cfg()
    # 33 kg: a mass at 8 rad/s, damped critically; of the turn about half a kg m^2.
    assist = AssistRoot(
        file=SET,
        stiffness=2000.0,
        damping=500.0,
        turn_stiffness=100.0,
        turn_damping=15.0,
        max_force=200.0,
        max_torque=50.0,
    )
    return assisted(cfg, assist, begin_step=6_000, end_step=24_000)


def track_set_cfg() -> ManagerBasedRlEnvCfg:
    """Return the config of following many motions of G1 with one policy: the package's, unless others are given.

    The policy sees the motion's joints now and at two later moments, since it has to tell the motions apart.
    """
    cfg = track_cfg(SET)
    names = tuple(f"g1_{clip}" for clip in ("walk", "squat", "turn", "kick"))
    return dataclasses.replace(
        cfg,
        scene=dataclasses.replace(cfg.scene, motions={SET: MotionSet(sources=names)}),
        observations=observations(SET, ahead_s=AHEAD_S),
        # The names that the field has for these errors.
        metrics={
            "mpkpe": terms.BodyDrift(file=SET, bodies=BODIES),
            "r_mpkpe": terms.BodyPosError(file=SET, anchor=ANCHOR, bodies=BODIES),
            "joint_pos_error": terms.MotionJointError(file=SET, joints=ROBOT.joint_names),
            "ee_pos_error": terms.BodyPosError(file=SET, anchor=ANCHOR, bodies=ENDS),
        },
        # Recordings last longer than our own motions; each ends with its clip.
        episode_length_s=60.0,
    )


def training() -> TrainingCfg:
    """Return the training settings: mjlab's, but that the first policy keeps to the motion, with half the noise."""
    return TrainingCfg(
        num_envs=4096,
        seed=42,
        objective=PPOCfg(entropy_coeff=0.005, precision="auto"),
        data=DatasetCfg(
            num_env_states_per_minibatch=ENV_STATES_PER_ITERATION // 4, num_minibatches=4
        ),
        modules=ModulesCfg(actor=ActorCfg(init_std=0.5)),
        trainer=TrainerCfg(num_iterations=ITERATIONS),
    )


def _task(clip: str, what: str, cfg: Callable[[str], ManagerBasedRlEnvCfg] = track_cfg) -> Task:
    return Task(
        name=f"g1_track_{clip}",
        description=f"Unitree G1 follows {what} with its whole body",
        cfg=partial(cfg, f"g1_{clip}"),
        training=training(),
        other_trainings=(velocity_training.fast_sac_training(symmetry="none"),),
    )


TASKS = (
    Task(
        name="g1_track",
        description="Unitree G1 follows many motions, a folder of them, with its whole body",
        cfg=track_set_cfg,
        training=training(),
    ),
    Task(
        name="g1_track_assisted",
        description="Unitree G1 follows motions that it cannot do, with help at its root that is withdrawn",
        cfg=assisted_cfg,
        training=training(),
    ),
    _task("walk", "a walk"),
    _task("squat", "squats"),
    _task("turn", "a turn on the spot"),
    _task("kick", "kicks on one leg"),
    _task("step", "steps onto a box and back down", on_box_cfg),
    _task("sit", "sitting down on a seat and rising", on_box_cfg),
)
"""The tasks, for the registry."""
