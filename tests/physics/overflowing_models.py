"""Scenes of every kind, in which things lie on the ground and each other, so that any room can be made too small."""

import functools

import mujoco
import numpy as np

from ksim_rl.physics import load_model

GROUNDS = {
    "plane": '<geom type="plane" size="3 3 0.1"/>',
    "box": '<geom type="box" size="3 3 0.1" pos="0 0 -0.1"/>',
    "mesh": '<geom type="mesh" mesh="slab" pos="0 0 -0.1"/>',
    "field": '<geom type="hfield" hfield="rough"/>',
}
SHAPES = {
    "sphere": 'type="sphere" size="0.08"',
    "capsule": 'type="capsule" size="0.05 0.1"',
    "box": 'type="box" size="0.1 0.08 0.06"',
    "cylinder": 'type="cylinder" size="0.08 0.06"',
    "ellipsoid": 'type="ellipsoid" size="0.1 0.08 0.06"',
    "mesh": 'type="mesh" mesh="brick"',
}
CUBE = "1 1 1  -1 1 1  1 -1 1  -1 -1 1  1 1 -1  -1 1 -1  1 -1 -1  -1 -1 -1"
SCENES = (
    ("plane", "box", "pyramidal", 3),
    ("plane", "mesh", "elliptic", 1),
    ("box", "capsule", "elliptic", 4),
    ("mesh", "cylinder", "pyramidal", 3),
    ("field", "sphere", "pyramidal", 3),
    ("field", "box", "pyramidal", 3),
    ("field", "capsule", "elliptic", 6),
    ("field", "cylinder", "pyramidal", 3),
    ("field", "mesh", "elliptic", 3),
)
"""Ground, shape of the things, cone and dimension of contacts."""


@functools.cache
def pile(ground: str, shape: str, cone: str, condim: int) -> mujoco.MjModel:
    """Return four things side by side, each with another on a hinge with friction, all joints beyond their limits."""
    elevation = " ".join(f"{height:.3f}" for height in np.random.default_rng(0).uniform(size=64))
    geom = f'<geom {SHAPES[shape]} mass="1"/>'
    hinge = '<joint axis="1 0 0" limited="true" range="0.01 0.02" frictionloss="0.1"/>'
    things = "".join(
        f'<body pos="{0.14 * index} 0 0.06"><freejoint/>{geom}<body pos="0 0.2 0">{hinge}{geom}</body></body>'
        for index in range(4)
    )
    return load_model(
        f"""<mujoco>
          <option timestep="0.002" cone="{cone}"/>
          <default><geom condim="{condim}"/></default>
          <asset>
            <hfield name="rough" nrow="8" ncol="8" size="1 1 0.15 0.1" elevation="{elevation}"/>
            <mesh name="brick" scale="0.1 0.1 0.1" vertex="{CUBE}"/>
            <mesh name="slab" scale="3 3 0.1" vertex="{CUBE}"/>
          </asset>
          <worldbody>{GROUNDS[ground]}{things}</worldbody>
        </mujoco>"""
    )


@functools.cache
def can_on_fine_field() -> mujoco.MjModel:
    """Return a cylinder on a height field whose cells are so small that it touches more than 50 prisms."""
    even = " ".join(["0"] * 1599 + ["1"])
    return load_model(
        f"""<mujoco>
          <asset><hfield name="fine" nrow="40" ncol="40" size="0.4 0.4 0.1 0.1" elevation="{even}"/></asset>
          <worldbody>
            <geom type="hfield" hfield="fine"/>
            <body pos="0 0 0.095"><freejoint/><geom type="cylinder" size="0.2 0.1"/></body>
          </worldbody>
        </mujoco>"""
    )


@functools.cache
def sensed_box(reduction: str) -> mujoco.MjModel:
    """Return a box that touches the floor in four points; MuJoCo Warp's contact sensor has room for two."""
    return load_model(
        f"""<mujoco>
          <custom><numeric name="contact_sensor_maxmatch" data="2"/></custom>
          <worldbody>
            <geom name="floor" type="plane" size="1 1 1"/>
            <body pos="0 0 0.099"><freejoint/><geom name="box" type="box" size="0.1 0.1 0.1"/></body>
          </worldbody>
          <sensor><contact geom1="box" geom2="floor" reduce="{reduction}" num="4" data="found dist"/></sensor>
        </mujoco>"""
    )


@functools.cache
def felt_crowd() -> mujoco.MjModel:
    """Return a body whose skin feels 55 balls at once, where MuJoCo Warp's tactile sensor keeps 50."""
    balls = "".join(
        f'<geom type="sphere" size="0.05" pos="{0.001 * index} 0 0.95"/>' for index in range(55)
    )
    return load_model(
        f"""<mujoco>
          <asset><mesh name="skin" builtin="sphere" params="0" scale="0.1 0.1 0.1"/></asset>
          <worldbody><body pos="0 0 1"><freejoint/><geom name="skin" type="mesh" mesh="skin"/></body>{balls}</worldbody>
          <sensor><tactile geom="skin" mesh="skin"/></sensor>
        </mujoco>"""
    )


@functools.cache
def bullet(flags: str = "") -> mujoco.MjModel:
    """Return a ball that is in a thin plate only half-way through its first substep, by Runge-Kutta's method."""
    return load_model(
        f"""<mujoco>
          <option timestep="0.002" integrator="RK4" gravity="0 0 0"><flag {flags}/></option>
          <worldbody>
            <geom type="box" size="0.1 0.1 0.001"/>
            <body pos="0 0 0.02"><freejoint/><geom type="sphere" size="0.005"/></body>
          </worldbody>
        </mujoco>"""
    )
