"""This module says what an actuator is: an edit of the model and, for our own motor models, a law per substep."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass

import mujoco
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import Checked, NonNegative, Positive
from ksim_rl.scene.actuators.drive import Drive
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.state.joint_targets import JointState, JointTarget, TargetKind

Law = Callable[[JointState, JointTarget], Float[Tensor, "E N"]]
"""The control [E, N] of a law's motors; of explicit ones, the effort itself."""


@dataclass(frozen=True, kw_only=True)
class Actuator(Checked, ABC):
    """What drives some joints of a robot, one actuator of the model for each of them.

    MuJoCo computes the effort of built-in actuators from `ctrl`, which is their target. Explicit ones are plain motors
    in the model, whose effort `law` computes before each substep.
    """

    @property
    @abstractmethod
    def driven(self) -> Patterns:
        """The names or patterns of the joints."""

    @property
    @abstractmethod
    def takes(self) -> frozenset[TargetKind]:
        """The kinds of target that have an effect."""

    @property
    def is_explicit(self) -> bool:
        """Whether `law` must run before each substep."""
        return False

    @property
    def params(self) -> Mapping[str, float]:
        """The numbers of the law by name: one float32 [E, L] buffer each, see `EnvView.actuator_param`."""
        return {}

    @property
    def law_key(self) -> Hashable:
        """Entries with equal keys differ in `params` only, so that one law computes all their joints."""
        return id(self)

    @abstractmethod
    def configure(self, actuator: mujoco.MjsActuator, joint: mujoco.MjsJoint) -> None:
        """Set up the new `actuator` of one joint, and the joint's own passive properties."""

    @abstractmethod
    def law(self, drive: Drive) -> Law:
        """Create what the law keeps, and return it."""


@dataclass(frozen=True, kw_only=True)
class JointActuator(Actuator):
    """What all actuators of joints have.

    Attributes:
        joints: names or patterns; each hinge or slide that matches gets an actuator of its name.
        effort_limit: bound of the effort, N m or N, symmetric; it takes the place of the joint's own limit in the MJCF.
            None keeps that one.
        armature: inertia of the motor as the joint feels it, kg m^2 or kg; None keeps the model's.
        frictionloss: dry friction, N m or N; None keeps the model's.
    """

    joints: Patterns
    effort_limit: Positive | None = None
    armature: NonNegative | None = None
    frictionloss: NonNegative | None = None

    @property
    def driven(self) -> Patterns:
        """The names or patterns of the joints."""
        return self.joints

    def configure(self, actuator: mujoco.MjsActuator, joint: mujoco.MjsJoint) -> None:
        """Set the limit of the force, and the joint's passive properties."""
        # Each attribute is written: the model's default class may hold others.
        actuator.gear = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
        actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_FALSE
        if self.effort_limit is not None:
            actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
            actuator.forcerange = [-self.effort_limit, self.effort_limit]
            joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        if self.armature is not None:
            joint.armature = self.armature
        if self.frictionloss is not None:
            joint.frictionloss = self.frictionloss


@dataclass(frozen=True, kw_only=True)
class ExplicitActuator(JointActuator):
    """A plain motor whose effort a law of ours computes before each substep, and keeps inside `effort_limit`.

    The law sees the state of the substep's start, so its damping is integrated explicitly: keep
    `damping * timestep` well below the inertia that the joint feels, or use a built-in actuator.
    """

    @property
    def is_explicit(self) -> bool:
        """True."""
        return True

    @property
    def params(self) -> Mapping[str, float]:
        """The limit, which each world may change; infinite for None."""
        return {"effort_limit": float("inf") if self.effort_limit is None else self.effort_limit}

    def configure(self, actuator: mujoco.MjsActuator, joint: mujoco.MjsJoint) -> None:
        """Make a motor whose control is its effort; the law holds the limit, which may differ between worlds."""
        super().configure(actuator, joint)
        actuator.set_to_motor()
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_FALSE
