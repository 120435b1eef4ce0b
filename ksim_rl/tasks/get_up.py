"""A legged robot that was dropped in any pose rises and then stands still: robots of our own, and Go1, G1 and T1.

An episode starts with the robot in the air, turned and bent at random; within half a second it lies on the ground.
The reward has no stages: height and uprightness lead up from any pose, and a good stance adds something on
top only as far as the robot is up. Falling over ends nothing.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl import mdp
from ksim_rl.checked import Positive
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.envs.term import MetricTerm, Reduction, RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.fields import root_height
from ksim_rl.modules import ActorCfg
from ksim_rl.physics import SimCfg
from ksim_rl.scene.robots.booster_t1 import GrippingT1
from ksim_rl.scene.robots.legged_robot import LeggedRobot
from ksim_rl.scene.robots.own_robots import Humanoid, Quadruped
from ksim_rl.scene.robots.unitree_g1 import UnitreeG1
from ksim_rl.scene.robots.unitree_go import UnitreeGo1
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.tasks import velocity, velocity_training
from ksim_rl.tasks.bent_joints import BendJointsApart
from ksim_rl.tasks.planar import upright
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg

# Rows of constraints: about 2.5 times the most that 64 robots needed that threw themselves about for 2 s (28, 125, 49).
GO1_ROWS = 96
G1_ROWS = 320
T1_ROWS = 128
# Joints begin within this of the default pose, rad.
BENT = (-0.6, 0.6)


@dataclass(frozen=True, kw_only=True)
class Uprightness(RewardTerm):
    """(1 + cos tilt) / 2 of the root, [E]: 1 upright, 0 upside down; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return upright(view)


@dataclass(frozen=True, kw_only=True)
class RisenHeight(RewardTerm):
    """The root's height above the ground as a fraction of the standing one (m), within [0, 1], [E]; position stage."""

    standing_height: Positive

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return risen(view, self.standing_height)


@dataclass(frozen=True, kw_only=True)
class Standing(RewardTerm):
    """uprightness^2 * risen^2 * exp(-mean((q - q0)^2) / pose_std^2) * exp(-mean(dq^2) / speed_std^2), in [0, 1], [E].

    `q0` is the default pose; units are m, rad and rad/s; position and velocity stage.
    """

    standing_height: Positive
    pose_std: Positive = 0.5
    speed_std: Positive = 2.0

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        # Squared, so that lying on the belly at half height gives little.
        up_E = (upright(view) * risen(view, self.standing_height)).square()
        stray_E = view.joint_pos_rel_EL.square().mean(-1) / self.pose_std**2
        motion_E = view.joint_vel_EL.square().mean(-1) / self.speed_std**2
        # Both exponents add up: one exponential for pose and speed.
        return up_E * torch.exp(-stray_E - motion_E)


@dataclass(frozen=True, kw_only=True)
class Stands(MetricTerm):
    """1 where the root is at 85 % of the standing height at least and tilted by at most 0.35 rad, else 0, [E].

    `reduce="last"` (the default) asks whether it stands in the end.
    """

    reduce: Reduction = "last"
    standing_height: float

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return stands(view, self.standing_height).to(torch.float32)


@dataclass(frozen=True, kw_only=True)
class StoodSoon(MetricTerm):
    """1 where it stands, as `Stands` has it, between `after_s` and `within_s` of the episode, else 0, [E].

    `reduce="max"` (the default) asks whether it has stood by then. Before `after_s` it may still fall from where it
    began, as high as it stands.
    """

    reduce: Reduction = "max"
    standing_height: float
    after_s: Positive = 0.5
    within_s: Positive = 3.0

    def _check_fields(self) -> None:
        super()._check_fields()
        if self.after_s >= self.within_s:
            raise ValueError(
                f"after_s={self.after_s}, within_s={self.within_s}: expected after_s < within_s"
            )

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        has_landed_E = view.episode_step_E > round(self.after_s / view.step_dt)
        is_early_E = view.episode_step_E <= round(self.within_s / view.step_dt)
        is_soon_E = has_landed_E & is_early_E
        return (is_soon_E & stands(view, self.standing_height)).to(torch.float32)


def stands(view: EnvView, standing_height: float) -> Bool[Tensor, " E"]:
    """Return where the root is at 85 % of the standing height (m) at least and tilted by at most 0.35 rad, [E]."""
    # Height alone would count a robot that stands on its head.
    is_high_E = root_height(view) > 0.85 * standing_height
    is_upright_E = -view.projected_gravity_EL[:, 2] > math.cos(0.35)
    return is_high_E & is_upright_E


def risen(view: EnvView, standing_height: float) -> Float[Tensor, " E"]:
    """Return the root's height as a fraction of the standing one, within [0, 1], [E]; position stage."""
    # A jump above the standing height gives no more.
    return (root_height(view) / standing_height).clamp(0.0, 1.0)


def get_up_cfg(
    robot: LeggedRobot,
    *,
    standing_height: float,
    drop_height: tuple[float, float],
    action_scale: Mapping[str, float],
    sim: SimCfg | None = None,
    imu: str = "imu",
    viewer: ViewerCfg,
) -> ManagerBasedRlEnvCfg:
    """Return the config: 50 Hz control for 6 s, for a root that stands at `standing_height`, m.

    Episodes start `drop_height` (m) above that, with joints up to 0.6 rad from the default pose. `sim` is
    `velocity.sim()` by default, and `imu` the site of the inertial sensor.
    """
    return ManagerBasedRlEnvCfg(
        decimation=4,
        sim=sim or velocity.sim(),
        scene=velocity.on_plane(robot),
        observations=_observations(robot, imu),
        actions={
            "joint_pos": mdp.JointPositionAction(joints=robot.joint_names, scale=action_scale)
        },
        rewards={
            "upright": Uprightness(weight=1.0),
            "height": RisenHeight(weight=1.0, standing_height=standing_height),
            "standing": Standing(weight=3.0, standing_height=standing_height),
            "dof_pos_limits": mdp.JointPosLimits(weight=-1.0),
            "action_rate_l2": mdp.ActionRateL2(weight=-0.01),
            "joint_vel_l2": mdp.JointVelL2(weight=-1e-4),
        },
        events={
            "drop": mdp.ResetRootUniform(
                pose_range={
                    **dict.fromkeys(("x", "y"), (-0.5, 0.5)),
                    "z": drop_height,
                    # Any orientation at all.
                    **dict.fromkeys(("roll", "pitch", "yaw"), (-math.pi, math.pi)),
                }
            ),
            "bend": mdp.ResetJoints(position_range=BENT),
            "encoder_bias": mdp.RandomizeEncoderBias(ranges=(-0.015, 0.015)),
            "foot_friction": velocity.foot_friction(robot, low=0.4, high=1.2),
        },
        # No fall ends the episode: falling is where it begins.
        terminations={"time_out": mdp.TimeOut()},
        metrics={"stands": Stands(standing_height=standing_height)},
        episode_length_s=6.0,
        viewer=viewer,
    )


def _observations(robot: LeggedRobot, imu: str) -> dict[str, ObservationGroupCfg]:
    """Return the velocity tasks' observations without velocity, command and feet; the critic also sees its height."""
    groups = velocity.observations(robot)
    # The actor has no linear velocity, which a robot cannot measure directly.
    own = ("base_ang_vel", "projected_gravity", "joint_pos_biased", "joint_vel", "actions")
    # The critic's joint positions have no encoder bias.
    seen = ("base_lin_vel", *own[:2], "joint_pos", *own[3:])
    actor = {name: groups["actor"].terms[name] for name in own}
    critic = {name: groups["critic"].terms[name] for name in seen}
    # Heights of the IMU and of the feet tell how far it has risen.
    height = ObservationTermCfg(term=mdp.FootHeight(sites=(imu, *robot.foot_sites)))
    return {
        "actor": ObservationGroupCfg(terms=actor),
        "critic": ObservationGroupCfg(terms={**critic, "imu_and_foot_height": height}),
    }


def quadruped_get_up() -> ManagerBasedRlEnvCfg:
    """Return the config of our own quadruped."""
    robot = Quadruped()
    return get_up_cfg(
        robot,
        standing_height=0.29,
        drop_height=(0.12, 0.2),
        action_scale={".*_roll": 0.4, ".*_(hip|knee)": 0.6},
        viewer=ViewerCfg(body=robot.root_body, distance=1.6, elevation=-15.0, azimuth=120.0),
    )


def humanoid_get_up() -> ManagerBasedRlEnvCfg:
    """Return the config of our own humanoid."""
    robot = Humanoid()
    return get_up_cfg(
        robot,
        standing_height=0.48,
        drop_height=(0.05, 0.15),
        action_scale={".*": 0.7},
        # Lying on its arms it needs 70 rows, and more as it kicks about: more than the probe of the model finds.
        sim=dataclasses.replace(velocity.sim(), njmax=128),
        viewer=ViewerCfg(body=robot.root_body, distance=2.2, elevation=-12.0, azimuth=130.0),
    )


# -- robots of the menagerie: nothing was trained yet, and heights, action scales and room are guesses -----------------


def _apart_and_soon(cfg: ManagerBasedRlEnvCfg) -> ManagerBasedRlEnvCfg:
    """Return the config with starts in which no limb lies inside another, and the metric of standing within 3 s.

    Joints bent by themselves have arms in the hips of T1 in 18 % of all starts, and of G1's 52 % are of such a kind.
    """
    in_the_end = cfg.metrics["stands"]
    assert isinstance(in_the_end, Stands)
    soon = StoodSoon(standing_height=in_the_end.standing_height)
    apart = BendJointsApart(position_range=BENT)
    return dataclasses.replace(
        cfg,
        metrics={**cfg.metrics, "stood_soon": soon},
        events={**(cfg.events or {}), "bend": apart},
    )


def _twice(scale: Mapping[str, float]) -> dict[str, float]:
    # Who lies on its back bends its legs by more than who walks.
    return {joint: 2.0 * reach for joint, reach in scale.items()}


def go1_get_up() -> ManagerBasedRlEnvCfg:
    """Return the config of Unitree Go1."""
    robot = UnitreeGo1()
    cfg = get_up_cfg(
        robot,
        standing_height=0.27,
        drop_height=(0.22, 0.32),
        action_scale=_twice(robot.action_scale),
        # As in its velocity tasks, with room for a whole body on the ground.
        sim=dataclasses.replace(velocity.sim(cone="elliptic", impratio=10.0), njmax=GO1_ROWS),
        viewer=ViewerCfg(body=robot.root_body, distance=1.5, elevation=-10.0, azimuth=90.0),
    )
    return _apart_and_soon(cfg)


def g1_get_up() -> ManagerBasedRlEnvCfg:
    """Return the config of Unitree G1."""
    robot = UnitreeG1()
    cfg = get_up_cfg(
        robot,
        standing_height=0.74,
        drop_height=(0.05, 0.15),
        action_scale=_twice(robot.action_scale),
        sim=dataclasses.replace(velocity.sim(), njmax=G1_ROWS),
        imu=robot.imu,
        viewer=ViewerCfg(body=robot.torso_body, distance=3.0, elevation=-10.0, azimuth=90.0),
    )
    return _apart_and_soon(cfg)


def t1_get_up() -> ManagerBasedRlEnvCfg:
    """Return the config of Booster T1, whose arms have friction here: it pushes itself up with them."""
    robot = GrippingT1()
    cfg = get_up_cfg(
        robot,
        standing_height=0.65,
        drop_height=(0.05, 0.15),
        action_scale={".*": 0.7},
        sim=dataclasses.replace(velocity.sim(), njmax=T1_ROWS),
        viewer=ViewerCfg(body=robot.root_body, distance=3.0, elevation=-10.0, azimuth=90.0),
    )
    return _apart_and_soon(cfg)


ON_FOUR_LEGS = velocity_training.training(num_iterations=1_000, entropy_coeff=0.005)
ON_TWO_LEGS = velocity_training.training(
    num_iterations=3_000, entropy_coeff=0.005, actor=ActorCfg(init_std=0.5)
)
QUADRUPED = Task(
    name="quadruped_get_up",
    description="our quadruped gets up from any pose",
    cfg=quadruped_get_up,
    training=ON_FOUR_LEGS,
)
HUMANOID = Task(
    name="humanoid_get_up",
    description="our humanoid gets up from any pose",
    cfg=humanoid_get_up,
    # An output layer of ordinary scale acts the more, the faster joints move, until statistics of observations are
    # known: the humanoid then throws itself about so hard that no engine simulates it, MuJoCo's own included.
    training=ON_TWO_LEGS,
)
GO1 = Task(
    name="go1_get_up",
    description="Unitree Go1 gets up from any pose",
    cfg=go1_get_up,
    training=ON_FOUR_LEGS,
)
G1 = Task(
    name="g1_get_up",
    description="Unitree G1 gets up from any pose",
    cfg=g1_get_up,
    training=ON_TWO_LEGS,
)
T1 = Task(
    name="t1_get_up",
    description="Booster T1 gets up from any pose",
    cfg=t1_get_up,
    training=ON_TWO_LEGS,
)
