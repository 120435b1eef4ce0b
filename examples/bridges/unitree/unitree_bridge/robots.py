"""What differs between Unitree's robots: messages, order of motors, and what a command has beside its motors."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

from unitree_bridge import go_messages, hg_messages

ENABLED = 1


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of robot.

    Attributes:
        joints: by name, in the order of the motors, which begins with motor 0.
        messages: the module of its messages.
        command: returns a new command, whose motors are off.
        layout: of the command's C struct, for its checksum.
    """

    name: str
    joints: tuple[str, ...]
    messages: Any
    command: Callable[[], Any]
    layout: str


def zeros(kind: Any) -> Any:
    """Return a message of zeros."""
    given = {}
    for field in fields(kind):
        given[field.name] = _zero(field.type)
    return kind(**given)


def _zero(annotation: Any) -> Any:
    if hasattr(annotation, "__idl__"):
        return zeros(annotation)
    kind, *rest = annotation.__metadata__
    # An array has its length and its parts in the first mark behind the type.
    if hasattr(kind, "length"):
        return [_zero(kind.subtype) for _ in range(kind.length)]
    return 0.0 if str(kind).startswith("float") else 0


def _go_command() -> Any:
    command = zeros(go_messages.LowCmd)
    command.head = [0xFE, 0xEF]
    command.level_flag = 0xFF
    return command


def _g1_command() -> Any:
    return zeros(hg_messages.LowCmd)


def _of_legs(legs: tuple[str, ...], parts: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{leg}_{part}_joint" for leg in legs for part in parts)


_LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
_ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll", "wrist_pitch")
_WAIST = ("waist_yaw_joint", "waist_roll_joint", "waist_pitch_joint")
GO2 = Kind(
    name="go2",
    joints=_of_legs(("FR", "FL", "RR", "RL"), ("hip", "thigh", "calf")),
    messages=go_messages,
    command=_go_command,
    layout="<4B4IH2x" + "B3x5f3I" * go_messages.NUM_MOTORS + "4B" + "55Bx2I",
)
G1 = Kind(
    name="g1",
    joints=(
        *_of_legs(("left", "right"), _LEG),
        *_WAIST,
        *_of_legs(("left", "right"), (*_ARM, "wrist_yaw")),
    ),
    messages=hg_messages,
    command=_g1_command,
    layout="<2B2x" + "B3x5fI" * hg_messages.NUM_MOTORS + "5I",
)
KINDS = {kind.name: kind for kind in (GO2, G1)}
