"""Poses and velocities are drawn uniformly from ranges by axis name; axes that are left out are 0."""

from collections.abc import Mapping, Sequence

from jaxtyping import Float
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


def draw(view: EnvView, ranges: Ranges) -> Float[Tensor, "E 6"]:
    """Draw x, y, z, roll, pitch, yaw (m and rad, or m/s and rad/s)."""
    pairs = [ranges.get(axis, (0.0, 0.0)) for axis in AXES]
    low_6 = constant([float(low) for low, _ in pairs], view.device)
    if all(low == high for low, high in pairs):
        return low_6.expand(view.num_envs, 6)
    high_6 = constant([float(high) for _, high in pairs], view.device)
    return view.uniform(6, low_6, high_6)
