"""Passive things for `SceneCfg.objects`; doors and whatever else has joints are `MjcfRobot`s of their MJCF."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar
from xml.sax.saxutils import quoteattr

import mujoco
import numpy as np

from ksim_rl.checked import Checked, Filled, NonNegative, Positive, Share, Within
from ksim_rl.physics import load_model, load_spec

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
LYING = (0.5**0.5, 0.0, 0.5**0.5, 0.0)
"""Orientations (w, x, y, z) at the start: as it is, and with its z axis ahead."""


@dataclass(frozen=True, kw_only=True)
class FreeBody(Checked):
    """A body with a free joint and one geom, all three called as `name` says. It starts at rest on the plane z = 0.

    The mass is in kg, evenly spread; friction is sliding (1), torsional (m) and rolling (m), as in MJCF.
    """

    mass: Positive = 0.1
    friction: tuple[NonNegative, NonNegative, NonNegative] = (0.6, 0.005, 0.0001)
    rgba: tuple[Share, Share, Share, Share] = (0.2, 0.5, 0.75, 1.0)

    name: ClassVar[str]

    @abstractmethod
    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""

    def add_to(
        self,
        spec: mujoco.MjSpec,
        kind: mujoco.mjtGeom,
        *,
        size: Sequence[float] = (),
        height: float,
        quat: Sequence[float] = UPRIGHT,
        meshname: str = "",
    ) -> mujoco.MjSpec:
        """Add body, joint and geom to a spec, at this height and orientation, and return the spec."""
        spec.modelname = self.name
        body = spec.worldbody.add_body(name=self.name, pos=[0.0, 0.0, height], quat=list(quat))
        body.add_freejoint(name=self.name)
        geom = body.add_geom(
            name=self.name,
            type=kind,
            mass=self.mass,
            friction=list(self.friction),
            rgba=list(self.rgba),
        )
        geom.meshname = meshname
        geom.size[: len(size)] = size
        return spec


@dataclass(frozen=True, kw_only=True)
class Box(FreeBody):
    """A box: body, joint and geom are all called "box". Edges are in m."""

    size: tuple[Positive, Positive, Positive] = (0.05, 0.05, 0.05)

    name = "box"

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        # MuJoCo takes half edges. Half an edge up, it rests on the plane.
        half = [edge / 2 for edge in self.size]
        return self.add_to(
            mujoco.MjSpec(), mujoco.mjtGeom.mjGEOM_BOX, size=half, height=self.size[2] / 2
        )


@dataclass(frozen=True, kw_only=True)
class Sphere(FreeBody):
    """A ball: body, joint and geom are all called "sphere". The radius is in m."""

    radius: Positive = 0.03

    name = "sphere"

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        size = [self.radius]
        return self.add_to(
            mujoco.MjSpec(), mujoco.mjtGeom.mjGEOM_SPHERE, size=size, height=self.radius
        )


@dataclass(frozen=True, kw_only=True)
class Cylinder(FreeBody):
    """A cylinder that stands: body, joint and geom are all called "cylinder". Radius and length are in m."""

    radius: Positive = 0.03
    length: Positive = 0.1

    name = "cylinder"

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        size = [self.radius, self.length / 2]
        return self.add_to(
            mujoco.MjSpec(), mujoco.mjtGeom.mjGEOM_CYLINDER, size=size, height=self.length / 2
        )


@dataclass(frozen=True, kw_only=True)
class Capsule(FreeBody):
    """A capsule that lies along x: body, joint and geom are all called "capsule".

    The radius is in m, and so is the length, of the cylinder between the two half balls.
    """

    radius: Positive = 0.03
    length: Positive = 0.1

    name = "capsule"

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        size = [self.radius, self.length / 2]
        kind = mujoco.mjtGeom.mjGEOM_CAPSULE
        # Upright it would fall over.
        return self.add_to(mujoco.MjSpec(), kind, size=size, height=self.radius, quat=LYING)


@dataclass(frozen=True, kw_only=True)
class Stand(Checked):
    """A block on the plane z = 0 that does not move, for things to stand on: body and geom are called "stand".

    Edges are in m; friction is sliding (1), torsional (m) and rolling (m), as in MJCF.
    """

    size: tuple[Positive, Positive, Positive] = (0.3, 0.3, 0.6)
    friction: tuple[NonNegative, NonNegative, NonNegative] = (0.6, 0.005, 0.0001)
    rgba: tuple[Share, Share, Share, Share] = (0.55, 0.5, 0.45, 1.0)

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        spec = mujoco.MjSpec()
        spec.modelname = "stand"
        half = [edge / 2 for edge in self.size]
        body = spec.worldbody.add_body(name="stand", pos=[0.0, 0.0, half[2]])
        body.add_geom(
            name="stand",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=half,
            friction=list(self.friction),
            rgba=list(self.rgba),
        )
        return spec


@dataclass(frozen=True, kw_only=True)
class Drawer(Checked):
    """A cabinet that does not move, with a drawer that slides out of it along -x: 0 is closed.

    The front is a square of 30 cm in the plane x = 0. Its handle is a bar of 16 cm along y, 7 cm before the front and
    near its upper edge, so that a gripper that points down has room. Bodies are "cabinet", "drawer" and "handle", the
    joint is "slide", and the site "grip" is the middle of the bar.

    Attributes:
        height: of the bar above the plane z = 0, m; the cabinet is 2 cm higher.
        travel: how far the drawer comes out, m.
        mass: of the drawer, kg.
        friction_loss, damping: of the slide, N and N s/m.
        friction: sliding (1), torsional (m) and rolling (m), as in MJCF.
    """

    height: Annotated[float, Within(low=0.3)] = 0.32
    travel: Positive = 0.25
    mass: Positive = 1.0
    friction_loss: NonNegative = 2.0
    damping: NonNegative = 5.0
    friction: tuple[NonNegative, NonNegative, NonNegative] = (1.0, 0.005, 0.0001)

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        friction = " ".join(f"{number:.9g}" for number in self.friction)
        slide = f'range="0 {self.travel:.9g}" damping="{self.damping:.9g}" frictionloss="{self.friction_loss:.9g}"'
        # What touches furniture says so itself: furniture does not touch itself.
        return load_spec(f"""
            <mujoco model="drawer">
              <default>
                <geom type="box" contype="3" conaffinity="0" friction="{friction}" rgba="0.6 0.45 0.3 1"/>
                <default class="handle"><geom type="capsule" size="0.008" rgba="0.2 0.2 0.25 1"/></default>
              </default>
              <worldbody>
                <body name="cabinet" pos="0 0 {self.height:.9g}">
                  <geom name="left" pos="0.17 0.155 -0.14" size="0.17 0.005 0.16"/>
                  <geom name="right" pos="0.17 -0.155 -0.14" size="0.17 0.005 0.16"/>
                  <geom name="top" pos="0.17 0 0.015" size="0.17 0.15 0.005"/>
                  <geom name="bottom" pos="0.17 0 -0.295" size="0.17 0.15 0.005"/>
                  <body name="drawer">
                    <joint name="slide" type="slide" axis="-1 0 0" limited="true" {slide}/>
                    <inertial pos="0.14 0 -0.14" mass="{self.mass:.9g}" diaginertia="0.02 0.02 0.02"/>
                    <geom name="front" pos="0.005 0 -0.14" size="0.005 0.148 0.148" rgba="0.7 0.55 0.4 1"/>
                    <geom name="tray" pos="0.15 0 -0.28" size="0.14 0.14 0.005"/>
                    <body name="handle">
                      <inertial pos="-0.07 0 0" mass="0.05" diaginertia="1e-4 1e-5 1e-4"/>
                      <geom name="bar" class="handle" fromto="-0.07 -0.08 0 -0.07 0.08 0"/>
                      <geom name="left_post" class="handle" fromto="-0.07 0.08 0 0 0.08 0"/>
                      <geom name="right_post" class="handle" fromto="-0.07 -0.08 0 0 -0.08 0"/>
                      <site name="grip" pos="-0.07 0 0"/>
                    </body>
                  </body>
                </body>
              </worldbody>
            </mujoco>
            """)


@dataclass(frozen=True, kw_only=True)
class Mesh(FreeBody):
    """A thing of a mesh, an OBJ, STL or MSH file: body, joint and geom are all called "mesh".

    It touches others with its convex hull, over which its mass is spread; `scale` multiplies the file's x, y and z,
    which are in m then.
    """

    file: Annotated[str, Filled("name the file of a mesh: .obj, .stl or .msh")]
    scale: tuple[Positive, Positive, Positive] = (1.0, 1.0, 1.0)

    name = "mesh"

    def data_files(self) -> Sequence[str]:
        """Return the mesh."""
        return (self.file,)

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        scale = " ".join(f"{factor:.9g}" for factor in self.scale)
        # As text, so that the file is looked at before MuJoCo opens it.
        text = (
            f'<mujoco><asset><mesh name="mesh" file={quoteattr(self.file)} scale="{scale}" inertia="convex"/></asset>'
            "</mujoco>"
        )
        kind = mujoco.mjtGeom.mjGEOM_MESH
        lying = load_model(self.add_to(load_spec(text), kind, height=0.0, meshname="mesh"))
        height = -_lowest(lying)
        return self.add_to(load_spec(text), kind, height=height, meshname="mesh")


def _lowest(mj_model: mujoco.MjModel) -> float:
    """Return the height of the lowest corner of the only mesh of a model."""
    data = mujoco.MjData(mj_model)
    mujoco.mj_kinematics(mj_model, data)
    corners_N3 = mj_model.mesh_vert @ data.geom_xmat[0].reshape(3, 3).T + data.geom_xpos[0]
    return float(np.min(corners_N3[:, 2]))
