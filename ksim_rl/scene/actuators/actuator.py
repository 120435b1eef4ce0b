"""The bases of actuators: an edit of the model and, for motor models of our own, a law per substep."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import torch
from jaxtyping import Bool, Float, Int64, Shaped
from torch import Tensor

from ksim_rl.checked import Checked, NonNegative, Positive
from ksim_rl.scene.names import Patterns, as_index
from ksim_rl.scene.state.joint_control import TargetKind
from ksim_rl.scene.state.joint_targets import JointState, JointTarget
from ksim_rl.scene.state.simulation import Simulation
from ksim_rl.scene.state.world_view import WorldView

Law = Callable[[JointState, JointTarget], Float[Tensor, "E N"]]
"""The control [E, N] of a law's motors; of explicit ones, the effort itself."""


class Drive:
    """The N joints of one law, in the model's order."""

    def __init__(
        self, name: str, simulation: Simulation, view: WorldView, joint_ids: Sequence[int]
    ) -> None:
        self.num_envs = view.num_envs
        self.num_joints = len(joint_ids)
        self.device = view.device
        self.name = name
        self._simulation = simulation
        self._view = view
        self._joints = view.joints().some(joint_ids)
        # Columns of the controls, in the order of the joints.
        self._motors = as_index([view.targets.motor(i) for i in joint_ids], view.device)
        self._at_reset: list[tuple[str, Callable[[Bool[Tensor, " E"]], None]]] = []

    def param(self, name: str) -> Float[Tensor, "E N"]:
        """Return the present values of a number of `Actuator.params`."""
        return self._view.actuator_param(name)[:, self._joints.index]

    def buffer(
        self, name: str, *shape: int, dtype: torch.dtype = torch.float32, keep: bool = False
    ) -> Shaped[Tensor, " E *shape"]:
        """Return a buffer of the law; rows that reset are zeroed unless `keep`."""
        full_name = f"{self.name}.{name}"
        return self._view.buffers.get(full_name, *shape, dtype=dtype, keep=keep, owner=self.name)

    def on_reset(self, draw: Callable[[Bool[Tensor, " E"]], None], *, stream: str = "") -> None:
        """Call `draw` with the mask of the rows that reset; it may draw by `integers`.

        Laws that draw from the same `stream` get the same numbers; without one they are the law's own.
        """
        self._at_reset.append((stream or self.name, draw))

    def integers(self, n: int, low: int, high: int) -> Int64[Tensor, "E L"]:
        """Draw from {low, ..., high}; the numbers depend on seed, law, env and count of resets only."""
        return self._view.integers(n, low, high)

    def reset(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Draw again for the rows of `mask_E`."""
        for stream, draw in self._at_reset:
            # Keyed by the number of resets, which differs between episodes of an env.
            with self._simulation.scope(stream, self._view.reset_count_E, draws="reset"):
                draw(mask_E)

    def state(self) -> JointState:
        """Return where the joints are now, in the middle of an env step too."""
        # From the state itself: derived quantities are stale in the middle of an env step.
        world = self._view.world
        joints = self._joints
        return JointState(world.qpos_EL[:, joints.qpos], world.qvel_EL[:, joints.qvel])

    def target(self) -> JointTarget:
        """Return the targets of the joints, of true positions as in `state`."""
        targets = self._view.targets
        joints = self._joints.index
        return JointTarget(
            targets.true_positions(joints), targets.vel_EL[:, joints], targets.effort_EL[:, joints]
        )

    def write(self, control_EN: Float[Tensor, "E N"]) -> None:
        """Set the controls of the motors."""
        self._view.world.ctrl_EL[:, self._motors] = control_EN


class SubstepRing:
    """The last `depth` values of a signal, the newest first; before an episode's first value lies that value."""

    def __init__(self, drive: Drive, name: str, depth: int, width: int) -> None:
        # Of a row that resets, the old values are never read again, so there is no need to clear it.
        self._ring_EKL = drive.buffer(f"{name}_EKL", depth, width, keep=True)
        # Cleared at resets, unlike the ring: it tells whether a row has a first value yet.
        self._started_E = drive.buffer(f"{name}_started_E", dtype=torch.bool)

    def push(self, value_EL: Float[Tensor, "E L"]) -> None:
        """Add the value of this substep."""
        newest_E1L = value_EL[:, None]
        # The newest comes first, and the oldest falls out.
        shifted_EKL = torch.cat((newest_E1L, self._ring_EKL[:, :-1]), dim=1)
        # Without a value before it, the first one fills the whole ring.
        self._ring_EKL.copy_(torch.where(self._started_E[:, None, None], shifted_EKL, newest_E1L))
        self._started_E.fill_(True)

    def at(self, lag: int) -> Float[Tensor, "E L"]:
        """Return the value of `lag` substeps ago."""
        return self._ring_EKL[:, lag]

    def at_rows(self, lag_E: Int64[Tensor, " E"]) -> Float[Tensor, "E L"]:
        """Return the value of each row's own number of substeps ago."""
        # `gather` wants an index as wide as its result.
        index_E1L = lag_E[:, None, None].expand(-1, 1, self._ring_EKL.shape[2])
        return self._ring_EKL.gather(1, index_E1L)[:, 0]


@dataclass(frozen=True, kw_only=True)
class Actuator(Checked, ABC):
    """The drive of some joints of a robot: one actuator of the model for each joint.

    MuJoCo computes the effort of built-in actuators from `ctrl`, which is their target. Explicit ones are plain motors
    in the model, whose effort `law` computes before each substep: of `is_explicit` entries it must run there.
    """

    is_explicit: ClassVar[bool] = False
    counts_substeps: ClassVar[bool] = False
    """Whether it remembers so many substeps, which are another time where the time step is another one."""
    takes: ClassVar[frozenset[TargetKind]] = frozenset()
    """The kinds of target that have an effect."""

    @property
    @abstractmethod
    def driven(self) -> Patterns:
        """The names or patterns of the joints."""

    @property
    def params(self) -> Mapping[str, float]:
        """The numbers of the law by name: one float32 [E, L] buffer each, see `EnvView.actuator_param`."""
        return {}

    @property
    def law_key(self) -> Hashable:
        """Entries with equal keys differ in `params` only, so that one law computes all their joints."""
        # By default each entry has a law to itself.
        return id(self)

    @abstractmethod
    def configure(self, actuator: mujoco.MjsActuator, joint: mujoco.MjsJoint) -> None:
        """Set up the new `actuator` of one joint, and the joint's own passive properties."""

    @abstractmethod
    def law(self, drive: Drive) -> Law:
        """Create the buffers of the law, and return it."""


@dataclass(frozen=True, kw_only=True)
class JointActuator(Actuator):
    """The base of all actuators of joints; each hinge or slide that `joints` matches gets an actuator of its name.

    `effort_limit` (N m or N, symmetric), `armature` (inertia of the motor as the joint feels it, kg m^2 or kg) and
    `frictionloss` (N m or N) take the place of the model's; None keeps those.
    """

    joints: Patterns
    effort_limit: Positive | None = None
    armature: NonNegative | None = None
    frictionloss: NonNegative | None = None

    @property
    def driven(self) -> Patterns:
        return self.joints

    def configure(self, actuator: mujoco.MjsActuator, joint: mujoco.MjsJoint) -> None:
        # Each attribute is written: the model's default class may hold others.
        # A gear of 1: control, force and effort are the same number.
        actuator.gear = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
        actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_FALSE
        if self.effort_limit is not None:
            actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
            actuator.forcerange = [-self.effort_limit, self.effort_limit]
            # The actuator's limit takes the place of the joint's; both would cut in turn.
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

    is_explicit = True

    @property
    def params(self) -> Mapping[str, float]:
        # Infinite rather than None, so that a clamp needs no case.
        return {"effort_limit": float("inf") if self.effort_limit is None else self.effort_limit}

    def configure(self, actuator: mujoco.MjsActuator, joint: mujoco.MjsJoint) -> None:
        """Make a motor whose control is its effort; the law holds the limit, which may differ between worlds."""
        super().configure(actuator, joint)
        actuator.set_to_motor()
        # The law clamps by a buffer; a fixed range in the model would cut it once more.
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_FALSE
