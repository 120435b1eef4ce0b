"""The tasks in which legged robots follow a velocity command on flat ground, two of them on rough too.

The figures of Go1 and G1 are from mjlab 1.6.0's `Mjlab-Velocity-Flat-Unitree-Go1` and `-G1`. The quadruped and the
humanoid are our own, with nothing to download; Go2's motors run PD control.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.modules import ActorCfg
from ksim_rl.scene.robots.booster_t1 import BoosterT1
from ksim_rl.scene.robots.own_robots import Humanoid, Quadruped
from ksim_rl.scene.robots.unitree_g1 import UnitreeG1
from ksim_rl.scene.robots.unitree_go import UnitreeGo1, UnitreeGo2
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.tasks import velocity, velocity_training
from ksim_rl.tasks.rough_ground import on_rough_ground, rated_by_contacts
from ksim_rl.trainers import TrainingCfg
from ksim_rl.transforms import ActionDelay, DelayCfg
from ksim_rl.transforms.transform_cfg import TransformCfg

GO1_ROBOT = UnitreeGo1()
GO2_ROBOT = UnitreeGo2()
QUADRUPED_ROBOT = Quadruped()
G1_ROBOT = UnitreeG1()
T1_ROBOT = BoosterT1()
HUMANOID_ROBOT = Humanoid()


def _task(
    cfg: Callable[[], ManagerBasedRlEnvCfg],
    robot: str,
    how: str = "on flat ground",
    *,
    num_iterations: int,
    others: Sequence[TrainingCfg] = (),
    **ppo: Any,
) -> Task:
    return Task(
        name=cfg.__name__,
        description=f"{robot} follows a velocity command {how}",
        cfg=cfg,
        training=velocity_training.training(num_iterations=num_iterations, **ppo),
        other_trainings=(velocity_training.fast_sac_training(), *others),
    )


# -- four legs ---------------------------------------------------------------------------------------------------


# Hips stray less than knees, which do the lifting.
def _four_legs_pose(hips: str, knees: str) -> velocity.PoseStd:
    moving = {hips: 0.3, knees: 0.6}
    return velocity.PoseStd(standing={hips: 0.05, knees: 0.1}, walking=moving, running=moving)


UNITREE_POSE = _four_legs_pose(".*_(hip|thigh)_joint", ".*_calf_joint")
UNITREE_VIEW = ViewerCfg(distance=1.5, elevation=-10.0, azimuth=90.0)
# Sliding, spinning and rolling: the contacts of Go1's feet have all six dimensions.
GO1_FRICTION = {
    "foot_friction_slide": velocity.foot_friction(GO1_ROBOT, axis=0, low=0.3, high=1.5),
    "foot_friction_spin": velocity.foot_friction(GO1_ROBOT, axis=1, low=1e-4, high=2e-2, log=True),
    "foot_friction_roll": velocity.foot_friction(GO1_ROBOT, axis=2, low=1e-5, high=5e-3, log=True),
}


def go1_velocity_flat() -> ManagerBasedRlEnvCfg:
    """Return the config of Unitree Go1."""
    return velocity.flat_cfg(
        GO1_ROBOT,
        UNITREE_POSE,
        # An elliptic cone with a high impratio keeps feet from creeping while they stand.
        physics=velocity.sim(cone="elliptic", impratio=10.0),
        feet=velocity.feet_sensor(geoms=GO1_ROBOT.foot_geoms),
        friction=GO1_FRICTION,
        viewer=dataclasses.replace(UNITREE_VIEW, body=GO1_ROBOT.root_body),
    )


def go2_velocity_flat() -> ManagerBasedRlEnvCfg:
    """Return the config of Unitree Go2."""
    return velocity.flat_cfg(
        GO2_ROBOT,
        UNITREE_POSE,
        feet=velocity.feet_sensor(geoms=GO2_ROBOT.foot_geoms),
        friction={"foot_friction": velocity.foot_friction(GO2_ROBOT, low=0.3, high=1.5)},
        viewer=dataclasses.replace(UNITREE_VIEW, body=GO2_ROBOT.root_body),
    )


def quadruped_velocity_flat() -> ManagerBasedRlEnvCfg:
    """Return the config of our own quadruped."""
    return velocity.flat_cfg(
        QUADRUPED_ROBOT,
        _four_legs_pose(".*_(roll|hip)", ".*_knee"),
        feet=velocity.feet_sensor(geoms=QUADRUPED_ROBOT.foot_geoms),
        foot_height=0.08,
        viewer=ViewerCfg(
            body=QUADRUPED_ROBOT.root_body, distance=1.6, elevation=-15.0, azimuth=120.0
        ),
    )


def quadruped_velocity_delayed() -> ManagerBasedRlEnvCfg:
    """Return the same with actions that arrive up to 40 ms late, as on a robot's bus: each env draws its own lags."""
    # Up to two env steps of 20 ms.
    lag = TransformCfg(ActionDelay, delay=DelayCfg(min_lag=0, max_lag=2))
    return dataclasses.replace(quadruped_velocity_flat(), transforms={"lag": lag})


GO1 = _task(
    go1_velocity_flat,
    "Unitree Go1",
    num_iterations=10_000,
    others=(velocity_training.fast_td3_training(),),
)
GO2 = _task(go2_velocity_flat, "Unitree Go2", num_iterations=10_000)
QUADRUPED = _task(quadruped_velocity_flat, "our quadruped", num_iterations=2_000)
DELAYED = _task(
    quadruped_velocity_delayed, "our quadruped", "with late actions", num_iterations=2_000
)


# -- two legs ----------------------------------------------------------------------------------------------------


def _pose(moving: Mapping[str, tuple[float, float]]) -> velocity.PoseStd:
    """Return how far joints may stray: little while standing, else by pattern (while walking, while running)."""
    walking = {joints: std for joints, (std, _) in moving.items()}
    running = {joints: std for joints, (_, std) in moving.items()}
    return velocity.PoseStd(standing={".*": 0.05}, walking=walking, running=running)


G1_POSE = _pose(
    {
        ".*_hip_pitch_joint": (0.3, 0.5),
        ".*_hip_(roll|yaw)_joint": (0.15, 0.2),
        ".*_knee_joint": (0.35, 0.6),
        ".*_ankle_pitch_joint": (0.25, 0.35),
        ".*_ankle_roll_joint": (0.1, 0.15),
        "waist_yaw_joint": (0.2, 0.3),
        "waist_roll_joint": (0.08, 0.08),
        "waist_pitch_joint": (0.1, 0.2),
        ".*_shoulder_pitch_joint": (0.15, 0.5),
        ".*_shoulder_roll_joint": (0.15, 0.2),
        ".*_shoulder_yaw_joint": (0.1, 0.15),
        ".*_elbow_joint": (0.15, 0.35),
        ".*_wrist_.*": (0.3, 0.3),
    }
)
T1_POSE = _pose(
    {
        ".*_Hip_Pitch": (0.3, 0.5),
        ".*_Hip_(Roll|Yaw)": (0.15, 0.2),
        ".*_Knee_Pitch": (0.35, 0.6),
        ".*_Ankle_Pitch": (0.25, 0.35),
        ".*_Ankle_Roll": (0.1, 0.15),
        "Waist": (0.2, 0.3),
        ".*_Shoulder_.*": (0.15, 0.4),
        ".*_Elbow_.*": (0.15, 0.35),
        "AAHead_yaw|Head_pitch": (0.1, 0.1),
    }
)
HUMANOID_POSE = _pose(
    {
        ".*_hip_pitch": (0.3, 0.5),
        ".*_hip_(roll|yaw)": (0.15, 0.2),
        ".*_knee": (0.35, 0.6),
        ".*_ankle_pitch": (0.25, 0.35),
        ".*_ankle_roll": (0.1, 0.15),
        "waist_yaw": (0.2, 0.3),
        ".*_shoulder_(pitch|roll)|.*_elbow": (0.15, 0.4),
    }
)


def g1_velocity_flat() -> ManagerBasedRlEnvCfg:
    """Return the config of Unitree G1."""
    torso = G1_ROBOT.torso_body
    return velocity.flat_cfg(
        G1_ROBOT,
        G1_POSE,
        is_biped=True,
        # Each foot is seven capsules of one subtree: one element per foot, not per geom.
        feet=velocity.feet_sensor(subtrees=G1_ROBOT.foot_bodies),
        torso=torso,
        # A robot that lies on its arms needs 221 rows, more than the probe of the model finds.
        physics=dataclasses.replace(velocity.sim(), njmax=256),
        viewer=ViewerCfg(body=torso, distance=3.0, elevation=-10.0, azimuth=90.0),
    )


def t1_velocity_flat() -> ManagerBasedRlEnvCfg:
    """Return the config of Booster T1."""
    return velocity.flat_cfg(
        T1_ROBOT,
        T1_POSE,
        is_biped=True,
        # Feet of several geoms count as one element each.
        feet=velocity.feet_sensor(subtrees=T1_ROBOT.foot_bodies),
        viewer=ViewerCfg(body=T1_ROBOT.root_body, distance=3.0, elevation=-10.0, azimuth=90.0),
    )


def humanoid_velocity_flat() -> ManagerBasedRlEnvCfg:
    """Return the config of our own humanoid."""
    return velocity.flat_cfg(
        HUMANOID_ROBOT,
        HUMANOID_POSE,
        is_biped=True,
        feet=velocity.feet_sensor(bodies=HUMANOID_ROBOT.foot_bodies),
        torso=HUMANOID_ROBOT.torso_body,
        foot_height=0.06,
        viewer=ViewerCfg(
            body=HUMANOID_ROBOT.root_body, distance=2.2, elevation=-12.0, azimuth=130.0
        ),
    )


# Two legs begin with actions near zero. With a discount of 0.98 G1 saves the cost of moving rather than its balance.
CALM: dict[str, Any] = {"actor": ActorCfg(init_std=0.5), "gamma": 0.99}
G1 = _task(g1_velocity_flat, "Unitree G1", num_iterations=30_000, **CALM)
T1 = _task(t1_velocity_flat, "Booster T1", num_iterations=30_000, actor=ActorCfg())
HUMANOID = _task(humanoid_velocity_flat, "our humanoid", num_iterations=3_000, actor=ActorCfg())


# -- rough ground ------------------------------------------------------------------------------------------------


def go1_velocity_rough() -> ManagerBasedRlEnvCfg:
    """Return the config of Unitree Go1."""
    flat = go1_velocity_flat()
    height = GO1_ROBOT.init_pos[2]
    return on_rough_ground(flat, root_height=height, njmax=208, nconmax=40)


def go1_velocity_rough_mjlab() -> ManagerBasedRlEnvCfg:
    """Return the config of Unitree Go1 with the terms of mjlab's task on rough ground, whose terrains are others."""
    legs = GO1_ROBOT.foot_sites
    return rated_by_contacts(
        go1_velocity_rough(),
        GO1_ROBOT,
        collides={
            "shank_collision": [f"{leg}_calf_collision{i}" for leg in legs for i in (1, 2)],
            "trunk_head_collision": ["trunk_collision", "head_collision"],
        },
        ends=[f"{leg}_thigh_collision{i}" for leg in legs for i in (1, 2, 3)],
        njmax=256,
        nconmax=64,
    )


def g1_velocity_rough() -> ManagerBasedRlEnvCfg:
    """Return the config of Unitree G1."""
    flat = g1_velocity_flat()
    height = G1_ROBOT.init_pos[2]
    return on_rough_ground(flat, root_height=height, njmax=840, nconmax=100)


ROUGH = "over stairs, slopes and rough ground"
GO1_ROUGH = _task(go1_velocity_rough, "Unitree Go1", ROUGH, num_iterations=10_000)
GO1_ROUGH_MJLAB = _task(
    go1_velocity_rough_mjlab, "Unitree Go1", f"{ROUGH}, rated as in mjlab", num_iterations=10_000
)
G1_ROUGH = _task(g1_velocity_rough, "Unitree G1", ROUGH, num_iterations=30_000, **CALM)
