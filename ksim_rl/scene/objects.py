"""Passive things for `SceneCfg.objects`."""

from dataclasses import dataclass

import mujoco

from ksim_rl.checked import Checked, NonNegative, Positive, Share


@dataclass(frozen=True, kw_only=True)
class Box(Checked):
    """A box with a free joint: body, joint and geom are all called "box". It starts at rest on the plane z = 0.

    Edges are in m, the mass in kg, evenly spread; friction is sliding (1), torsional (m) and rolling (m), as in MJCF.
    """

    size: tuple[Positive, Positive, Positive] = (0.05, 0.05, 0.05)
    mass: Positive = 0.1
    friction: tuple[NonNegative, NonNegative, NonNegative] = (0.6, 0.005, 0.0001)
    rgba: tuple[Share, Share, Share, Share] = (0.2, 0.5, 0.75, 1.0)

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        spec = mujoco.MjSpec()
        spec.modelname = "box"
        # Half an edge up, so that it rests on the plane.
        body = spec.worldbody.add_body(name="box", pos=[0.0, 0.0, self.size[2] / 2])
        body.add_freejoint(name="box")
        body.add_geom(
            name="box",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            # MuJoCo takes half edges.
            size=[edge / 2 for edge in self.size],
            mass=self.mass,
            friction=list(self.friction),
            rgba=list(self.rgba),
        )
        return spec
