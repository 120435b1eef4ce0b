"""The numbers of motor models, one row per world."""

import math
from collections.abc import Collection, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checks import unknown_name
from ksim_rl.scene.state.buffers import Buffers


class ActuatorParams:
    """Buffers by name (`stiffness`, `effort_limit`, ...), float32 [E, L], in the order of `joint_pos_EL`.

    They start at the numbers of the config, are read at each substep, are saved with the env, and stay when rows
    reset; so an event may write them in place, for some rows, at any moment. A joint that has no such number (its
    actuator is built-in, or of another kind) has 0 there, which nothing reads.
    """

    def __init__(self, buffers: Buffers, joint_names: Sequence[str], device: torch.device) -> None:
        self._all_buffers, self._joint_names, self._device = buffers, list(joint_names), device
        self._buffers: dict[str, Tensor] = {}
        self._nominal: dict[str, Tensor] = {}
        self._owners: dict[str, dict[int, float]] = {}

    def add(self, name: str, joints: Sequence[int], value: float) -> None:
        """Give some joints a number; during construction only."""
        if name not in self._buffers:
            nominal_L = self._nominal[name] = torch.zeros(len(self._joint_names), device=self._device)
            self._buffers[name] = self._all_buffers.get(
                f"actuators.{name}_EL", len(self._joint_names), keep=True, initial=nominal_L
            )
        self._nominal[name][list(joints)] = value
        self._buffers[name].copy_(self._nominal[name].expand_as(self._buffers[name]))
        self._owners.setdefault(name, {}).update(dict.fromkeys(joints, value))

    def get(self, name: str, joints: Collection[int] = ()) -> Float[Tensor, "E L"]:
        """Return the present numbers, [E, L]; an error if one of `joints` has none."""
        self._check(name, joints)
        return self._buffers[name]

    def nominal(self, name: str) -> Float[Tensor, " L"]:
        """Return the numbers of the config, [L]."""
        self._check(name, ())
        return self._nominal[name]

    def joints(self, name: str, *, finite: bool = False) -> frozenset[int]:
        """Return the joints that have this number; with `finite`, those whose number in the config is finite."""
        owners = self._owners.get(name, {})
        return frozenset(joint for joint, value in owners.items() if not finite or math.isfinite(value))

    def _check(self, name: str, joints: Collection[int]) -> None:
        if name not in self._buffers:
            raise unknown_name("parameter of explicit actuators", name, self._buffers)
        for joint in joints:
            if joint not in self._owners[name]:
                raise ValueError(
                    f"the actuator of joint {self._joint_names[joint]!r} has no parameter {name!r}: those of built-in "
                    "actuators are the model fields actuator_gainprm, actuator_biasprm and actuator_forcerange"
                )
