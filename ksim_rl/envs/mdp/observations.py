"""Observation terms: clean readings, float32 [E, L]. Noise, delay and history are transforms.

Joints come in the order of the term's `joints`; ".*" is the model's order.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from ksim_rl.envs.names import Patterns
from ksim_rl.envs.term import ObservationTerm
from ksim_rl.envs.view import EnvView

# -- root --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class RootPos(ObservationTerm):
    """Position of the root body's frame in the world, m, [E, 3]; position stage."""

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.root_pos_EL


@dataclass(frozen=True, kw_only=True)
class RootQuat(ObservationTerm):
    """Orientation of the root body, body to world, (w, x, y, z), [E, 4]; position stage."""

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.root_quat_EL


@dataclass(frozen=True, kw_only=True)
class RootLinVel(ObservationTerm):
    """Linear velocity of the root body's frame origin, in the root's frame, m/s, [E, 3]; velocity stage."""

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.root_lin_vel_b_EL


@dataclass(frozen=True, kw_only=True)
class RootAngVel(ObservationTerm):
    """Angular velocity of the root body, in the root's frame, rad/s, [E, 3]; velocity stage."""

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.root_ang_vel_b_EL


@dataclass(frozen=True, kw_only=True)
class ProjectedGravity(ObservationTerm):
    """Direction of gravity (world -z) in the root's frame, a unit vector, [E, 3]; (0, 0, -1) when upright."""

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.projected_gravity_EL


# -- joints ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class JointPos(ObservationTerm):
    """Positions of joints, rad or m, [E, L]; position stage."""

    joints: Patterns = ".*"

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.joint_pos_EL[:, view.joints(self.joints)]


@dataclass(frozen=True, kw_only=True)
class JointPosRel(ObservationTerm):
    """Positions of joints minus the default pose, rad or m, [E, L]; position stage.

    Attributes:
        biased: add the encoders' bias (`RandomizeEncoderBias`), as the robot itself would read them.
    """

    joints: Patterns = ".*"
    biased: bool = False

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        index = view.joints(self.joints)
        pos_EL = view.joint_pos_rel_EL[:, index]
        return pos_EL + view.encoder_bias_EL[:, index] if self.biased else pos_EL


@dataclass(frozen=True, kw_only=True)
class JointVel(ObservationTerm):
    """Velocities of joints, rad/s or m/s, [E, L]; velocity stage."""

    joints: Patterns = ".*"

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.joint_vel_EL[:, view.joints(self.joints)]


# -- sensors, action, command ------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class SensorReading(ObservationTerm):
    """The reading of an MJCF sensor by name, [E, dim], with the frame, unit and stage of that sensor.

    A gyro or velocimeter reads at its site, in the site's frame, at the velocity stage.
    """

    sensor: str

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.sensor(self.sensor)


@dataclass(frozen=True, kw_only=True)
class LastAction(ObservationTerm):
    """The action that led to the current state, as the policy gave it, [E, K]; zero after a reset."""

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.action_EL


@dataclass(frozen=True, kw_only=True)
class Command(ObservationTerm):
    """A command by name, [E, K]."""

    command: str

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.command(self.command)


# -- feet --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class FootHeight(ObservationTerm):
    """Heights of sites above flat ground (z = 0), m, [E, F]; position stage."""

    sites: Patterns

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.site_pos_w(view.sites(self.sites))[..., 2]


@dataclass(frozen=True, kw_only=True)
class FootAirTime(ObservationTerm):
    """Seconds since each foot left the ground, 0 while it touches, [E, F]; acceleration stage."""

    sensor: str

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.contact(self.sensor).air_time_EN


@dataclass(frozen=True, kw_only=True)
class FootContact(ObservationTerm):
    """1 where a foot touches the ground, else 0, [E, F]; acceleration stage."""

    sensor: str

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.contact(self.sensor).found_EN


@dataclass(frozen=True, kw_only=True)
class FootContactForces(ObservationTerm):
    """Net force of each foot on the ground, world frame, sign(f) log(1 + |f|) of newtons, [E, 3F]; acceleration stage.

    MuJoCo's sign: a foot that stands presses down, z is negative.
    The logarithm keeps an impact of hundreds of newtons in the range of the other observations.
    """

    sensor: str

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        force_EL = view.contact(self.sensor).force_EN3.flatten(start_dim=1)
        return torch.sign(force_EL) * torch.log1p(torch.abs(force_EL))
