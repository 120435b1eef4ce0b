"""Uniform draws of a pose or a velocity: ranges by axis name, 0 for the axes that are left out."""

from collections.abc import Mapping, Sequence

from torch import Tensor

from ksim_rl.checks import check_pair, unknown_name
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant

AXES = ("x", "y", "z", "roll", "pitch", "yaw")
Ranges = Mapping[str, tuple[float, float]]


def check_ranges(field: str, ranges: Ranges, axes: Sequence[str] = AXES) -> None:
    """Refuse axes that are none of `axes` and ranges that are no ordered pairs.

    Raises:
        ValueError: naming the field, the axis and the value.
    """
    for axis, pair in ranges.items():
        if axis not in axes:
            raise unknown_name(f"axis in {field}", axis, axes)
        check_pair(f"{field}.{axis}", pair)


def draw(view: EnvView, ranges: Ranges) -> Tensor:
    """Draw x, y, z, roll, pitch, yaw (m and rad, or m/s and rad/s), float32 [E, 6]."""
    pairs = [ranges.get(axis, (0.0, 0.0)) for axis in AXES]
    low_6 = constant([float(low) for low, _ in pairs], view.device)
    if all(low == high for low, high in pairs):
        return low_6.expand(view.num_envs, 6)
    high_6 = constant([float(high) for _, high in pairs], view.device)
    return view.uniform(6, low_6, high_6)
