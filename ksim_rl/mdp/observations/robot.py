"""These observations read a robot's joints, actuators, root and sensors, the last action, commands and time.

Joints and actuators have one column each in the order of the term's patterns.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Literal

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from ksim_rl.checked import Filled, NonNegative, Positive, Range, Within
from ksim_rl.envs.term import ObservationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant
from ksim_rl.mdp.fields import InFrame, OfCommand, OfEntity, OfJoints, OfSensor
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.sensors.rays import grid_points
from ksim_rl.transforms.trackers import time_left


@dataclass(frozen=True, kw_only=True)
class EncodedJoints(OfJoints, ObservationTerm):
    """A reading of joint positions, with the encoders' bias (`RandomizeEncoderBias`), as a robot reads them, or not."""

    biased: bool = False

    def read(self, view: EnvView, pos_EL: Float[Tensor, "E L"]) -> Float[Tensor, "E L"]:
        """Return the encoders' readings at these positions of the joints."""
        # A real robot's policy sees its encoders' readings, with their bias.
        if self.biased:
            return pos_EL + view.joints(self.joints).encoder_bias_EL
        return pos_EL


@dataclass(frozen=True, kw_only=True)
class JointPos(EncodedJoints):
    """Positions of joints, rad or m; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return self.read(view, view.joints(self.joints).pos_EL)


@dataclass(frozen=True, kw_only=True)
class JointPosRel(EncodedJoints):
    """Positions of joints minus the default pose, rad or m; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return self.read(view, view.joints(self.joints).pos_rel_EL)


@dataclass(frozen=True, kw_only=True)
class JointPosTarget(OfJoints, ObservationTerm):
    """Positions that joints were last asked for, rad or m, [E, L]; beside `JointPos` it shows how well they follow."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.joint_pos_target_EL[:, view.joints(self.joints).index]


@dataclass(frozen=True, kw_only=True)
class JointVel(OfJoints, ObservationTerm):
    """Velocities of joints, rad/s or m/s, [E, L]; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.joints(self.joints).vel_EL


@dataclass(frozen=True, kw_only=True)
class JointAcc(OfJoints, ObservationTerm):
    """Accelerations of joints, rad/s^2 or m/s^2, [E, L]; acceleration stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.joints(self.joints).acc_EL


@dataclass(frozen=True, kw_only=True)
class JointEffort(OfJoints, ObservationTerm):
    """The effort of actuators on joints, behind their gears, N m or N, [E, L]; acceleration stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.joints(self.joints).effort_EL


@dataclass(frozen=True, kw_only=True)
class ActuatorForce(ObservationTerm):
    """Forces of actuators, before their gears, N or N m, [E, L]; acceleration stage."""

    actuators: Patterns = ".*"

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        # By actuator, as tendons and muscles have no joint of their own.
        return view.world.actuator_force_EL[:, view.resolver.index("actuator", self.actuators)]


@dataclass(frozen=True, kw_only=True)
class RootPos(OfEntity, ObservationTerm):
    """Position of the root body's frame in the world, m, [E, 3]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.entity(self.entity).root_pos_EL


@dataclass(frozen=True, kw_only=True)
class RootQuat(OfEntity, ObservationTerm):
    """Orientation of the root body, body to world, (w, x, y, z), [E, 4]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.entity(self.entity).root_quat_EL


@dataclass(frozen=True, kw_only=True)
class RootRotation6d(OfEntity, ObservationTerm):
    """The root's x axis, then its y axis, in the world, without jumps (Zhou et al. 2019), [E, 6]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.entity(self.entity).root.axes_E33[:, :2].flatten(start_dim=1)


@dataclass(frozen=True, kw_only=True)
class RootLinVel(InFrame, ObservationTerm):
    """Linear velocity of the root body's frame origin, in the axes of `frame`, m/s, [E, 3]; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        entity = view.entity(self.entity)
        if self.frame == "root":
            return entity.root_lin_vel_b_EL
        return entity.root_lin_vel_w_EL


@dataclass(frozen=True, kw_only=True)
class RootAngVel(InFrame, ObservationTerm):
    """Angular velocity of the root body, in the axes of `frame`, rad/s, [E, 3]; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        entity = view.entity(self.entity)
        if self.frame == "root":
            return entity.root_ang_vel_b_EL
        # In the world's axes it is rotated once per state.
        return entity.root_ang_vel_w_EL


@dataclass(frozen=True, kw_only=True)
class ProjectedGravity(OfEntity, ObservationTerm):
    """Direction of gravity (world -z) in the root's frame, a unit vector, [E, 3]; (0, 0, -1) when upright.

    Position stage. `time_constant` (s) belongs to a first-order lag, as the attitude filter of an IMU has; a reset
    fills it with the new orientation. Dead time, as of a bus, is the business of the group's delay.
    """

    time_constant: NonNegative = 0.0

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        gravity_E3 = view.entity(self.entity).projected_gravity_EL
        # No lag, no buffers.
        if self.time_constant == 0.0:
            return gravity_E3
        steps_E = view.buffer("steps_E", dtype=torch.int64)
        filtered_E3 = view.buffer("filtered_E3", 3)
        # Exact for a gravity that is constant over the step, at any ratio of step and time constant.
        gain = 1.0 - math.exp(-view.step_dt / self.time_constant)
        # The first reading of an episode fills the filter.
        gain_E = torch.where(steps_E == 0, 1.0, gain)
        filtered_E3.lerp_(gravity_E3, gain_E[:, None])
        steps_E.add_(1)
        # A mean of unit vectors is shorter than 1.
        return torch.nn.functional.normalize(filtered_E3, dim=-1)


@dataclass(frozen=True, kw_only=True)
class SensorReading(OfSensor, ObservationTerm):
    """The reading of an MJCF sensor by name, [E, dim]; a gyro's is in its site's frame, at the velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.sensor(self.sensor)


@dataclass(frozen=True, kw_only=True)
class LastAction(ObservationTerm):
    """The action that led to the current state, as the policy gave it, [E, K]; 0 at first; `history` keeps more."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.action_EL


@dataclass(frozen=True, kw_only=True)
class Command(OfCommand, ObservationTerm):
    """A command by name, [E, K]."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.command(self.command)


@dataclass(frozen=True, kw_only=True)
class EpisodeTime(ObservationTerm):
    """Time since the start of the episode, s, [E, 1]."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.episode_time_E[:, None]


@dataclass(frozen=True, kw_only=True)
class RemainingTime(ObservationTerm):
    """Time until the episode times out (`TimeOut`), s, [E, 1]; `TimeAwareObservation` counts it in any env."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        if view.max_episode_length == 0:
            raise ValueError(
                "RemainingTime with episode_length_s=0: episodes never time out; set episode_length_s"
            )
        # The offset makes staggered first episodes shorter.
        passed_E = view.episode_step_E + view.time_out_offset_E
        return time_left(view.max_episode_length, passed_E)[:, None] * view.step_dt


@dataclass(frozen=True, kw_only=True)
class Clock(ObservationTerm):
    """sin, then cos, of 2 pi (frequency t + phase), `t` the episode's time, [E, 2P]; Hz, and cycles, one per foot."""

    frequency: Positive
    phases: Annotated[tuple[float, ...], Filled("give at least one, such as (0.0,)")] = (0.0,)

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        # Phases are in cycles; 2 pi makes them angles on the host.
        offsets_P = constant([2.0 * math.pi * phase for phase in self.phases], view.device)
        angle_EP = view.episode_time_E[:, None] * (2.0 * math.pi * self.frequency) + offsets_P
        return torch.cat((angle_EP.sin(), angle_EP.cos()), dim=-1)


@dataclass(frozen=True, kw_only=True)
class ImuReading(OfSensor, ObservationTerm):
    """One quantity of an `ImuSensor` of `scene.sensors`, in its own axes, float32 [E, 3], or [E, 4] for "quat".

    "ang_vel" (rad/s; velocity stage), "lin_acc" (m/s^2, +9.81 upwards at rest; acceleration stage), "quat" ((w, x, y,
    z), to the world; position stage) or "projected_gravity" (unit vector; position stage).
    """

    quantity: Literal["ang_vel", "lin_acc", "quat", "projected_gravity"] = "ang_vel"

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return getattr(view.imu(self.sensor), f"{self.quantity}_EL")


@dataclass(frozen=True, kw_only=True)
class CameraImage(OfSensor, ObservationTerm):
    """The picture of a `CameraSensor` in the current state (position stage); the only term of its observation group.

    "rgb" (uint8 [E, H, W, 3]), "depth" (m, float32 [E, H, W]) or "segmentation" (ids of geoms, -1 for none, int32
    [E, H, W]).
    """

    is_image = True

    output: Literal["rgb", "depth", "segmentation"] = "rgb"

    def __call__(self, view: EnvView) -> Shaped[Tensor, " E *image"]:
        camera = view.camera(self.sensor)
        # The camera calls it by its channels.
        if self.output == "rgb":
            return camera.rgb_EHW3
        # Depth and segmentation have one number per pixel, and no channels.
        return getattr(camera, f"{self.output}_EHW")


@dataclass(frozen=True, kw_only=True)
class RayDistance(OfSensor, ObservationTerm):
    """Distances to the rays' first hits, m, the sensor's `max_distance` where there is none, [E, N]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.rays(self.sensor).state.distance_EN


@dataclass(frozen=True, kw_only=True)
class RayHeight(OfSensor, ObservationTerm):
    """How far the ends of the rays are below the sensor, minus `offset`, clipped, m, [E, N]; position stage.

    With a `GridPattern` that starts well above the robot it is a height scan that sees everything, not only terrain.
    """

    offset: float = 0.0
    clip: Range = (-1.0, 1.0)

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        tracker = view.rays(self.sensor)
        # World z of the sensor minus world z of the hits.
        below_EN = tracker.origin_EN3[..., 2] - tracker.state.point_EN3[..., 2] - self.offset
        return below_EN.clamp(*self.clip)


@dataclass(frozen=True, kw_only=True)
class HeightScan(OfEntity, ObservationTerm):
    """How far the ground is below the root at the points of a grid, minus `offset`, clipped, m, [E, L]; position stage.

    The grid is centred on the root and turns with its yaw only. Points run along x (forward) first, from back to front,
    and these rows along y, from right to left. Heights are of the terrain itself, exactly and without casting
    rays: nothing else that stands there is seen (`scene.sensors` with a `RayCaster` does). Ground that is higher
    reads lower; on flat ground all points read root height - offset. `size` has the grid's edges along x and y, m.
    """

    size: Annotated[tuple[float, float], Within(low=0.0)] = (1.6, 1.0)
    resolution: Positive = 0.1
    offset: float = 0.5
    clip: Range = (-1.0, 1.0)

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        scan = view.entity(self.entity).ground_scan(_grid(tuple(self.size), self.resolution))
        return (scan.below_EN - self.offset).clamp(*self.clip)


@cache
def _grid(size: tuple[float, float], resolution: float) -> tuple[tuple[float, float], ...]:
    """Return x and y of the points about the root, m; made once."""
    return tuple((x, y) for x, y, _ in grid_points(size, resolution).tolist())
