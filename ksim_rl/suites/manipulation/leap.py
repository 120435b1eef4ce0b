"""A LEAP hand turns a cube in its palm to one orientation after another, as MuJoCo Playground's LeapCubeReorient.

Its file `reorient.py` is the source of all formulas.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from ksim_rl import mdp
from ksim_rl.checked import NonNegativeRange, Positive, Range, Share
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.term import (
    CommandRanges,
    CommandTerm,
    MetricTerm,
    ObservationTerm,
    Reduction,
    RewardTerm,
)
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import array_constant
from ksim_rl.mdp.fields import OfCommand, OfSensor
from ksim_rl.physics import SimCfg
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.scene import SceneCfg
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.suites.dm_control.quantities import (
    Distance,
    Factor,
    Offset,
    Readings,
    ToleranceProduct,
)
from ksim_rl.suites.manipulation.bodies import AXES, LeavesBox, PlaceFreeBody, PlaygroundModel
from ksim_rl.suites.manipulation.targets import JointTarget, MoveTargets, TargetsAtJoints
from ksim_rl.transforms import GaussianNoise, UniformNoise
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg

GOAL = "goal"
CUBE = "cube"
CUBE_ORIENTATION = "cube_orientation"
HAND = "(if|mf|rf|th)_.*"
TIPS = tuple(f"{finger}_tip_position" for finger in ("th", "if", "mf", "rf"))
CONTROL_S = 0.05
REACHED_RAD = 0.1
_LAST_AXES = np.eye(3)[None, 1:]


@dataclass(frozen=True, kw_only=True)
class GoalOrientation(CommandTerm):
    """The orientation that an object should take, a quaternion (w, x, y, z), [E, 4], uniform when an episode begins.

    When the object gets within `reached` (rad), the goal starts to turn about its own axes, at a velocity (rad/s) with
    each component from `turn`, which a factor of `decay` slows down in each env step. So it moves away and comes to
    rest; the reaching itself is rewarded before it moves. A mocap body of the model shows it.

    Attributes:
        sensor: the MJCF sensor of the object's orientation, a quaternion.
    """

    sensor: str
    mocap: str
    reached: Positive = REACHED_RAD
    turn: Range = (2.0, 10.0)
    decay: Share = 0.8
    resampling_time_range_s: NonNegativeRange | None = None

    def bounds(self, view: EnvView, ranges: CommandRanges) -> Sequence[tuple[float, float]]:
        return [(-1.0, 1.0)] * 4

    def resample(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        """Draw an orientation; its turn and its count of steps are zero in rows that reset."""
        goal_E4 = view.buffer("goal_E4", 4)
        # A normalized normal draw is uniform over orientations.
        drawn_E4 = normalize(view.normal(4), dim=-1)
        goal_E4.copy_(torch.where(mask_E[:, None], drawn_E4, goal_E4))
        # The mocap body follows right away, for the first picture.
        shown_E4 = self._shown(view)
        shown_E4.copy_(torch.where(mask_E[:, None], goal_E4, shown_E4))

    def __call__(self, view: EnvView) -> Float[Tensor, "E 4"]:
        """Move the goal if an env step has passed, and return it."""
        goal_E4 = view.buffer("goal_E4", 4)
        turn_E3 = view.buffer("turn_E3", 3)
        steps_E = view.buffer("steps_E", dtype=torch.int64)
        # No env step has passed when a row has just been reset, so that its goal stays where it was drawn.
        moves_E1 = (steps_E != view.episode_step_E)[:, None]
        # Against the goal from before this step, which the rewards have seen.
        is_reached_E1 = (
            quaternion.angle_between(view.sensor(self.sensor), goal_E4) <= self.reached
        )[:, None]
        next_E3 = torch.where(is_reached_E1, view.uniform(3, *self.turn), self.decay * turn_E3)
        turn_E3.copy_(torch.where(moves_E1, next_E3, turn_E3))
        # Half the angle of this step, since quaternions turn by halves.
        half_E3 = 0.5 * view.step_dt * turn_E3
        angle_E1 = torch.linalg.vector_norm(half_E3, dim=-1, keepdim=True)
        # (cos a, sin(a) / a * v), with sinc(x) = sin(pi x) / (pi x), 1 at 0.
        vector_E3 = torch.sinc(angle_E1 / math.pi) * half_E3
        step_E4 = torch.cat((torch.cos(angle_E1), vector_E3), dim=-1)
        # Normalized again: rounding adds up over 1000 steps.
        turned_E4 = normalize(quaternion.multiply(goal_E4, step_E4), dim=-1)
        goal_E4.copy_(torch.where(moves_E1, turned_E4, goal_E4))
        # Now both counts agree until the next env step.
        steps_E.copy_(view.episode_step_E)
        self._shown(view).copy_(goal_E4)
        return goal_E4.clone()

    def _shown(self, view: EnvView) -> Tensor:
        """The orientation of the mocap body, [E, 4], to be written in place."""
        # No quantity that derives from that body's pose is read before the next substep.
        mocap = int(view.world.mj_model.body_mocapid[view.resolver.one("body", self.mocap)])
        return view.world.view("mocap_quat")[:, mocap]


@dataclass(frozen=True, kw_only=True)
class OfGoal(OfCommand, OfSensor):
    """A term of an orientation that a command asks for, and of the MJCF sensor of the object's."""

    command: str = GOAL
    sensor: str = CUBE_ORIENTATION


@dataclass(frozen=True, kw_only=True)
class GoalAngle(OfGoal, ObservationTerm):
    """The angle between an object and its goal, rad in [0, pi], [E, 1]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E 1"]:
        return quaternion.angle_between(view.sensor(self.sensor), view.command(self.command))[
            :, None
        ]


@dataclass(frozen=True, kw_only=True)
class GoalTurn(OfGoal, ObservationTerm):
    """The last two rows of the matrix that turns the goal into the object, world frame, [E, 6]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E 6"]:
        goal_E4 = view.command(self.command)
        # Object times the inverse of the goal: the turn from goal to object, world frame.
        turn_E4 = quaternion.multiply(view.sensor(self.sensor), quaternion.conjugate(goal_E4))
        axes_123 = array_constant(_LAST_AXES, view.device)
        # Rows of the matrix are images of unit vectors under the inverse.
        return quaternion.rotate_inverse(turn_E4[:, None], axes_123).flatten(start_dim=1)


@dataclass(frozen=True, kw_only=True)
class GoalsReached(OfGoal, MetricTerm):
    """How often in an episode an object was within `reached` (rad) of its goal, [E]; position stage."""

    reduce: Reduction = "sum"
    reached: Positive = REACHED_RAD

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        angle_E1 = GoalAngle(command=self.command, sensor=self.sensor)(view)
        return (angle_E1[:, 0] <= self.reached).to(torch.float32)


@dataclass(frozen=True, kw_only=True)
class ActuatorPower(RewardTerm):
    """Sum of |force of an actuator| * |velocity of its joint|, W, [E]; joints and actuators stand in the same order.

    Acceleration stage. Unlike `Energy` it takes forces before a joint's own limit (`actuatorfrcrange`) cuts them.
    """

    joints: Patterns
    actuators: Patterns = ".*"

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        force_EN = view.world.actuator_force_EL[:, view.resolver.index("actuator", self.actuators)]
        # Absolute values: braking costs as much as driving.
        return (force_EN * view.joints(self.joints).vel_EL).abs().sum(-1)


def leap_cube_reorient() -> ManagerBasedRlEnvCfg:
    """Return the config: 20 Hz control, episodes of 1000 steps, rewards per second but for reaching a goal."""
    pos = mdp.JointPos(joints=HAND)
    offset = Offset(ends=("site:grasp_site",), start=f"com:{CUBE}")
    turn = GoalTurn()
    actor = {
        "joint_pos": ObservationTermCfg(term=pos, noise=UniformNoise(low=-0.05, high=0.05)),
        "joint_target": ObservationTermCfg(term=JointTarget(joints=HAND)),
        "cube_offset": ObservationTermCfg(term=offset, noise=UniformNoise(low=-0.02, high=0.02)),
        # Playground adds normal noise of 0.1 to each number of the cube's quaternion, and normalizes: it turns the cube
        # by about 0.2 rad (std) about each axis. As much on each number of two axes tells as much of the orientation.
        "cube_turn": ObservationTermCfg(term=turn, noise=GaussianNoise(std=0.2)),
        "last_action": ObservationTermCfg(term=mdp.LastAction()),
    }
    critic = {
        "joint_pos": ObservationTermCfg(term=pos),
        "joint_vel": ObservationTermCfg(term=mdp.JointVel(joints=HAND)),
        "fingertips": ObservationTermCfg(term=Readings(sensors=TIPS)),
        "cube_offset": ObservationTermCfg(term=offset),
        "cube_turn": ObservationTermCfg(term=turn),
        "cube_velocity": ObservationTermCfg(term=Readings(sensors=("cube_linvel", "cube_angvel"))),
    }
    near = Factor(of=Distance(of=offset), high=0.02, margin=0.05, shape="linear")
    turned = Factor(of=GoalAngle(), high=0.2, margin=math.pi, shape="linear")
    reached = Factor(of=GoalAngle(), high=REACHED_RAD)
    return ManagerBasedRlEnvCfg(
        decimation=5,
        scene=SceneCfg(robots={"leap": PlaygroundModel(scene="leap_cube")}, num_envs=8192),
        # Playground stops after 5 iterations of the solver and 8 of its line search, which leaves grasps half solved.
        sim=SimCfg(iterations=10, ls_iterations=20, ccd_iterations=10, njmax=160),
        observations={
            "actor": ObservationGroupCfg(terms=actor),
            "critic": ObservationGroupCfg(terms=critic),
        },
        actions={"joints": MoveTargets(joints=HAND, scale=0.5)},
        events={
            "hand": mdp.ResetJoints(
                joints=HAND, position_range=(0.0, 0.1), distribution="gaussian"
            ),
            "targets": TargetsAtJoints(joints=HAND),
            "cube": PlaceFreeBody(
                body=CUBE, offset=dict.fromkeys(AXES, (-0.01, 0.01)), orientation="uniform"
            ),
        },
        commands={GOAL: GoalOrientation(sensor=CUBE_ORIENTATION, mocap="goal")},
        rewards={
            "orientation": ToleranceProduct(factors={"turned": turned}, weight=5.0),
            "position": ToleranceProduct(factors={"near": near}, weight=0.5),
            # 100 for each time, whatever a step lasts.
            "reached": ToleranceProduct(factors={"reached": reached}, weight=100.0 / CONTROL_S),
            "dropped": mdp.Terminated(weight=-100.0),
            "hand_pose": mdp.JointDeviationL2(joints=HAND, weight=-0.5),
            "action_rate": mdp.ActionRateL2(weight=-0.001),
            "action_acceleration": mdp.ActionAccelerationL2(weight=-0.001),
            "power": ActuatorPower(joints=HAND, weight=-0.001),
        },
        terminations={"time_out": mdp.TimeOut(), "dropped": LeavesBox(body=CUBE, low={"z": -0.05})},
        metrics={"goals_reached": GoalsReached()},
        episode_length_s=1000 * CONTROL_S,
        viewer=ViewerCfg(lookat=(0.15, 0.05, 0.0), distance=0.7, elevation=-30.0, azimuth=140.0),
    )
