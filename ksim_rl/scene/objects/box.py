"""A box that moves freely."""

from dataclasses import dataclass

import mujoco

from ksim_rl.checks import check_in_range


@dataclass(frozen=True, kw_only=True)
class Box:
    """A box with a free joint: body, joint and geom are all called "box". It starts at rest on the plane z = 0.

    Attributes:
        size: edge lengths, m.
        mass: kg, evenly spread.
        friction: sliding (1), torsional (m) and rolling (m) coefficients, as in MJCF.
        rgba: colour and opacity.
    """

    size: tuple[float, float, float] = (0.05, 0.05, 0.05)
    mass: float = 0.1
    friction: tuple[float, float, float] = (0.6, 0.005, 0.0001)
    rgba: tuple[float, float, float, float] = (0.2, 0.5, 0.75, 1.0)

    def __post_init__(self) -> None:
        for index, edge in enumerate(self.size):
            check_in_range(f"size[{index}]", edge, low=0.0, low_open=True)
        check_in_range("mass", self.mass, low=0.0, low_open=True)
        for field, high in (("friction", None), ("rgba", 1.0)):
            for index, value in enumerate(getattr(self, field)):
                check_in_range(f"{field}[{index}]", value, low=0.0, high=high)

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        spec = mujoco.MjSpec()
        spec.modelname = "box"
        body = spec.worldbody.add_body(name="box", pos=[0.0, 0.0, self.size[2] / 2])
        body.add_freejoint(name="box")
        body.add_geom(
            name="box",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[edge / 2 for edge in self.size],
            mass=self.mass,
            friction=list(self.friction),
            rgba=list(self.rgba),
        )
        return spec
