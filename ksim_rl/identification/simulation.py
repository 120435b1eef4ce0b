"""Simulates a held robot under logged targets, with many choices of its numbers at the same time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import mujoco.batch
import numpy as np
from jaxtyping import Float

from ksim_rl.identification.held_robot import KINDS, TIME_STEP, HeldRobot
from ksim_rl.scene.state.joint_control import TargetKind

Array = np.ndarray
FACTORS: Mapping[TargetKind, str] = {
    "pos": "stiffness",
    "vel": "servo_damping",
    "effort": "torque_constant",
}
"""The number that turns each kind of target into an effort."""
# Fields that MuJoCo derives from the armature.
_DERIVED = ("dof_invweight0", "body_invweight0", "actuator_acc0", "dof_M0")


@dataclass(frozen=True, kw_only=True)
class Targets:
    """The commands of the joints: each value is held until the next one.

    Attributes:
        time_T: s.
        by_kind: "pos" (rad or m), "vel" (per second) and "effort" (N m or N), each [T, N] in the order of the joints.
    """

    time_T: Float[Array, " T"]
    by_kind: Mapping[TargetKind, Float[Array, "T N"]]

    @cached_property
    def _integrals(self) -> dict[TargetKind, Float[Array, "T N"]]:
        """Integrals of the targets from the first time on; linear in between, so means of any stretch are exact."""
        lasts_T1 = np.diff(self.time_T)[:, None]
        found = {}
        for kind, values_TN in self.by_kind.items():
            sums_TN = np.cumsum(values_TN[:-1] * lasts_T1, axis=0)
            found[kind] = np.vstack((np.zeros_like(values_TN[:1]), sums_TN))
        return found

    def of_steps(
        self, start_s: float, count: int, delay_s: float
    ) -> dict[TargetKind, Float[Array, "S N"]]:
        """Return the means of the targets over `count` time steps from `start_s` on, as they arrive, late."""
        edges_S = start_s - delay_s + TIME_STEP * np.arange(count + 1)
        # Before the first target it was there already, and after the last it stays.
        early_S = np.minimum(edges_S - self.time_T[0], 0.0)
        late_S = np.maximum(edges_S - self.time_T[-1], 0.0)
        means = {}
        for kind, values_TN in self.by_kind.items():
            columns = []
            for column_T, first, last in zip(
                self._integrals[kind].T, values_TN[0], values_TN[-1], strict=True
            ):
                inside_S = np.interp(edges_S, self.time_T, column_T)
                columns.append(np.diff(inside_S + early_S * first + late_S * last) / TIME_STEP)
            means[kind] = np.stack(columns, axis=1)
        return means


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One choice of a robot's numbers: `numbers_NP` [N, P] by joint and `KINDS`, and how late its targets arrive, s."""

    numbers_NP: Float[Array, "N P"]
    delay_s: float


def asked(
    numbers_NP: Float[Array, "N P"], by_kind: Mapping[TargetKind, Float[Array, "S N"]]
) -> Float[Array, "S N"]:
    """Return the targets' contribution to the effort of motors with these parameters, N m or N."""
    total_SN = np.zeros((1, len(numbers_NP)))
    for kind, target_SN in by_kind.items():
        total_SN = total_SN + numbers_NP[:, KINDS.index(FACTORS[kind])] * target_SN
    return total_SN


def efforts(
    numbers_NP: Float[Array, "N P"],
    by_kind: Mapping[TargetKind, Float[Array, "S N"]],
    pos_SN: Float[Array, "S N"],
    vel_SN: Float[Array, "S N"],
) -> Float[Array, "S N"]:
    """Return the efforts that motors with these numbers and targets would exert without a limit, N m or N."""
    stiffness_N = numbers_NP[:, KINDS.index("stiffness")]
    damping_N = numbers_NP[:, KINDS.index("servo_damping")]
    return asked(numbers_NP, by_kind) - stiffness_N * pos_SN - damping_N * vel_SN


class Simulation:
    """Runs a held robot from the same start under the same targets, for several candidates at a time."""

    def __init__(self, robot: HeldRobot, targets: Targets, *, num_candidates: int) -> None:
        self._robot = robot
        self._targets = targets
        model = robot.mj_model
        self._qpos = np.array([model.joint(name).qposadr[0] for name in robot.joint_names])
        self._dof = np.array([model.joint(name).dofadr[0] for name in robot.joint_names])
        self._batch = mujoco.batch.Batch(model, num_candidates)
        for name in (
            "dof_armature",
            "dof_damping",
            "dof_frictionloss",
            "actuator_biasprm",
            *_DERIVED,
        ):
            self._batch.expand(name)

    def positions(
        self,
        candidates: Sequence[Candidate],
        read_s_R: Float[Array, " R"],
        start_N: Float[Array, " N"],
    ) -> Float[Array, "K R N"]:
        """Return the joints' positions at some times, rad or m, of robots that rest at `start_N` at the first time."""
        first = float(read_s_R[0])
        count = int(np.ceil((read_s_R[-1] - first) / TIME_STEP)) + 1
        numbers_KNP = np.stack([candidate.numbers_NP for candidate in candidates])
        self._set_numbers(numbers_KNP)
        ctrl_KSN = np.stack([self._controls(candidate, first, count) for candidate in candidates])
        ids = np.arange(len(candidates), dtype=np.int32)
        self._batch.reset(ids=ids)
        self._batch.qpos[ids[:, None], self._qpos] = start_N
        found = self._batch.rollout(count, control=ctrl_KSN, record=("qpos", "qvel"), ids=ids)
        return self._at(
            read_s_R - first, start_N, found["qpos"][..., self._qpos], found["qvel"][..., self._dof]
        )

    def _set_numbers(self, numbers_KNP: Float[Array, "K N P"]) -> None:
        some = len(numbers_KNP)
        for field in ("armature", "damping", "frictionloss"):
            entries = self._batch.expand(f"dof_{field}")
            # A damping has three coefficients; the first is the linear one.
            rows = entries.reshape(len(entries), entries.shape[1], -1)
            rows[:some, self._dof, 0] = numbers_KNP[..., KINDS.index(field)]
        bias = self._batch.expand("actuator_biasprm")
        bias[:some, :, 1] = -numbers_KNP[..., KINDS.index("stiffness")]
        bias[:some, :, 2] = -numbers_KNP[..., KINDS.index("servo_damping")]
        # Dry friction is scaled by what the engine derives from the inertia.
        self._batch.set_const()

    def _controls(self, candidate: Candidate, first: float, count: int) -> Float[Array, "S N"]:
        arrived = self._targets.of_steps(first, count, candidate.delay_s)
        return asked(candidate.numbers_NP, arrived)

    def _at(
        self,
        after_s_R: Float[Array, " R"],
        start_N: Float[Array, " N"],
        qpos_KSN: Float[Array, "K S N"],
        qvel_KSN: Float[Array, "K S N"],
    ) -> Float[Array, "K R N"]:
        """Read positions between the steps, by the cubic through positions and velocities at both ends."""
        start_K1N = np.broadcast_to(start_N, (len(qpos_KSN), 1, len(start_N)))
        qpos_KSN = np.concatenate((start_K1N, qpos_KSN), axis=1)
        qvel_KSN = np.concatenate((np.zeros_like(start_K1N), qvel_KSN), axis=1)
        step_R = np.minimum((after_s_R / TIME_STEP).astype(int), qpos_KSN.shape[1] - 2)
        s_R1 = (after_s_R / TIME_STEP - step_R)[:, None]
        # Hermite's basis on [0, 1].
        value_0 = (1.0 + 2.0 * s_R1) * (1.0 - s_R1) ** 2
        value_1 = s_R1**2 * (3.0 - 2.0 * s_R1)
        slope_0 = s_R1 * (1.0 - s_R1) ** 2 * TIME_STEP
        slope_1 = -(s_R1**2) * (1.0 - s_R1) * TIME_STEP
        at_0 = value_0 * qpos_KSN[:, step_R] + slope_0 * qvel_KSN[:, step_R]
        at_1 = value_1 * qpos_KSN[:, step_R + 1] + slope_1 * qvel_KSN[:, step_R + 1]
        return at_0 + at_1
