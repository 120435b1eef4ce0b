"""Identified parameters of a robot, with their uncertainty, as a table and as a file."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass

from ksim_rl.identification.held_robot import KINDS

UNITS = {
    "armature": "kg m^2 or kg",
    "damping": "N m s/rad or N s/m, of the joint itself",
    "frictionloss": "N m or N",
    "stiffness": "N m/rad or N/m, of the servo",
    "servo_damping": "N m s/rad or N s/m, of the servo",
    "torque_constant": "N m at the joint for one that is commanded",
}


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A number, and half the width of its 95 % interval; both NaN where the log does not tell it, as `remark` says."""

    value: float = math.nan
    half_width: float = math.nan
    remark: str = ""

    @property
    def is_told(self) -> bool:
        """Whether the log tells it."""
        return math.isfinite(self.value)

    @property
    def low(self) -> float:
        """The lower end of the interval, not below 0: no number of a joint is negative."""
        return max(self.value - self.half_width, 0.0)

    @property
    def high(self) -> float:
        """The upper end."""
        return self.value + self.half_width


@dataclass(frozen=True, kw_only=True)
class Findings:
    """The numbers of a robot's joints by joint and by the names of `KINDS`.

    Attributes:
        robot: its name.
        joints: by joint.
        delay_s: from a command's time to the reading that shows it, of the whole way.
        unexplained: the root mean square of what the simulation does not follow, rad or m, by joint.
        warnings: lines about what is doubtful.
    """

    robot: str
    joints: Mapping[str, Mapping[str, Estimate]]
    delay_s: Estimate
    unexplained: Mapping[str, float]
    warnings: tuple[str, ...] = ()

    def table(self) -> str:
        """Return the findings as lines of text."""
        width = max(len(name) for name in self.joints) + 2
        lines = [" " * width + "".join(f"{kind:>24}" for kind in KINDS)]
        for name, numbers in self.joints.items():
            lines.append(
                f"{name:<{width}}" + "".join(f"{_short(numbers[kind]):>24}" for kind in KINDS)
            )
        delay = self.delay_s
        lines.append(f"delay {delay.value * 1e3:.2f} +- {delay.half_width * 1e3:.2f} ms")
        remarks = {}
        for name, numbers in self.joints.items():
            for kind, number in numbers.items():
                if number.remark:
                    remarks.setdefault(f"{kind}: {number.remark}", []).append(name)
        for remark, names in remarks.items():
            lines.append(f"{remark} ({', '.join(names)})")
        return "\n".join(lines)

    def text(self, overrides: Mapping[str, list[str]]) -> str:
        """Return the content of the file that keeps them, which is YAML and JSON alike."""
        joints = {}
        for name, numbers in self.joints.items():
            joints[name] = {kind: _entry(number) for kind, number in numbers.items()}
        tree = {
            "robot": self.robot,
            "units": UNITS,
            "delay_s": _entry(self.delay_s),
            "joints": joints,
            "unexplained": {name: round(value, 8) for name, value in self.unexplained.items()},
            "warnings": list(self.warnings),
            "overrides": overrides,
        }
        return json.dumps(tree, indent=1) + "\n"


def _short(number: Estimate) -> str:
    if not number.is_told:
        return "-"
    return f"{number.value:.4g} +- {number.half_width:.2g}"


def _entry(number: Estimate) -> dict[str, float | str | None]:
    entry: dict[str, float | str | None] = {"value": None, "half_width": None}
    if number.is_told:
        entry = {"value": _rounded(number.value), "half_width": _rounded(number.half_width)}
    if number.remark:
        entry["remark"] = number.remark
    return entry


def _rounded(value: float) -> float:
    """Return a number with six digits: more would claim a precision that is not there."""
    return float(f"{value:.6g}")
