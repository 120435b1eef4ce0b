"""This module has the fields that learned motor models share: their file, and the units of inputs and output."""

from dataclasses import dataclass
from typing import Any

from ksim_rl.checks import check_in_range
from ksim_rl.scene.actuators.actuator import ExplicitActuator
from ksim_rl.scene.actuators.net_file import NetFile, read_net_file
from ksim_rl.scene.state.joint_targets import TargetKind

_SCALES = ("position_scale", "velocity_scale", "effort_scale")


@dataclass(frozen=True, kw_only=True)
class NetActuator(ExplicitActuator):
    """A motor whose effort a small network predicts from position errors and velocities, joint by joint.

    One network serves all joints of the entry, as in Hwangbo et al., "Learning agile and dynamic motor skills for
    legged robots", Science Robotics 4 (2019). Its effort is kept inside the effort limit.

    Attributes:
        file: path of a safetensors file with the weights.
        sha256: what the file must hash to (hexadecimal); None takes any.
        position_scale, velocity_scale: multiply position errors (target - position, rad or m) and velocities (rad/s or
            m/s) on their way in. None: the file's metadata of that name, else 1.
        effort_scale: multiplies the output, which gives N m or N. None: likewise.
    """

    file: str
    sha256: str | None = None
    position_scale: float | None = None
    velocity_scale: float | None = None
    effort_scale: float | None = None

    @property
    def takes(self) -> frozenset[TargetKind]:
        """A position."""
        return frozenset({"pos"})

    def read(self) -> NetFile:
        """Read the file.

        Raises:
            ValueError: in one line, if it is missing, damaged or another one.
        """
        return read_net_file(self.file, self.sha256)

    def scales(self, net: NetFile) -> tuple[float, float, float]:
        """Return the scales of position error, velocity and effort."""
        position, velocity, effort = (float(self.setting(net, name, 1.0)) for name in _SCALES)
        return position, velocity, effort

    def setting(self, net: NetFile, name: str, default: Any = None) -> Any:
        """Return a field or, if that is None, the metadata of its name, as text, or the default.

        Raises:
            ValueError: if none of them has it, or the metadata is no number where the field is one.
        """
        value = getattr(self, name)
        if value is not None:
            return value
        text = net.metadata.get(name)
        if text is None:
            if default is None:
                raise ValueError(f"{net.where}: no {name!r} in its metadata: give the field `{name}`")
            return default
        if name in _SCALES:
            try:
                number = float(text)
            except ValueError:
                raise ValueError(f"{net.where}: {name}={text!r} in its metadata: expected a number") from None
            check_in_range(f"{net.where}: {name}", number)
            return number
        return text
