"""Models of what no generated model has: flexes, distance fields, sensors of touch, and settings of searches."""

import warp as wp

from benchmarks.judge.trial import Verdict, judge

_VERTICES = "0.08 0 0 -0.05 0.07 0 -0.06 -0.06 0.01 0 0.01 0.09 0.02 -0.01 -0.07 0.03 0.05 0.04"
_STONE = f'<mesh name="stone" vertex="{_VERTICES}"/>'
_GROUND = '<geom type="plane" size="2 2 .1"/>'


def _model(bodies: str, *, option: str = "", asset: str = "", more: str = "") -> str:
    return f"<mujoco>{option}<asset>{asset}</asset><worldbody>{_GROUND}{bodies}</worldbody>{more}</mujoco>"


def _flex(name: str, count: str, pos: str, dim: int, inside: str, dof: str = "full") -> str:
    settings = f'spacing=".1 .1 .1" mass="1" radius=".01" dof="{dof}"'
    return f'<flexcomp name="{name}" type="grid" count="{count}" pos="{pos}" dim="{dim}" {settings}>{inside}</flexcomp>'


_BOX = (
    '<body name="box" pos="0 0 .09"><freejoint/><geom name="box" type="box" size=".1 .1 .1"/>'
    '<geom name="pad" type="mesh" mesh="stone" pos="0 0 -.05" contype="0" conaffinity="0"/><site name="s"/></body>'
)
_CAMERAS = (
    '<camera name="c" mode="targetbody" target="box" pos="1 1 1" resolution="4 4"/>'
    '<camera name="d" mode="targetbodycom" target="box" pos="1 -1 1"/>'
    '<light mode="targetbody" target="box" pos="0 0 2"/><light mode="targetbodycom" target="box" pos="0 1 2"/>'
)
_SENSORS = (
    '<sensor><camprojection name="eye" site="s" camera="c"/><user name="own" dim="2"/>'
    '<contact name="speeds" geom1="box" data="found linvel angvel" num="2"/>'
    '<tactile name="skin" geom="pad" mesh="stone"/></sensor>'
)
_EDGES = '<edge equality="true" damping=".1"/>'
# By what they show.
MODELS = {
    "readings": _model(_BOX + _CAMERAS, asset=_STONE, more=_SENSORS),
    "ropes": _model(_flex("rope", "4 1 1", "0 0 .012", 1, '<edge stiffness="100" damping="1"/>')),
    "cloths": _model(
        _flex("cloth", "3 3 1", "0 0 .5", 2, _EDGES),
        option='<option><flag contact="disable"/></option>',
    ),
    "solids": _model(
        _flex("jelly", "2 2 2", "0 0 .5", 3, '<elasticity young="5e4" poisson=".2" damping=".1"/>')
    ),
    "solids of few coordinates": _model(
        _flex(
            *("jelly", "3 3 3", "0 0 .3", 3),
            '<edge equality="strain"/><contact selfcollide="none"/>',
            dof="trilinear",
        )
    ),
    "distance fields": _model(
        '<body pos="0 0 .3"><freejoint/><geom type="sdf" mesh="stone"/></body>', asset=_STONE
    ),
    "noslip": _model(
        _BOX, asset=_STONE, option='<option noslip_iterations="3" noslip_tolerance="1e-2"/>'
    ),
    "searches": _model(
        _BOX,
        asset=_STONE,
        option='<option ccd_iterations="20" ccd_tolerance="1e-4" sdf_iterations="5" sdf_initpoints="20"/>',
    ),
    # Where it lies on the ground.
    "cloths that touch": _model(
        _flex("cloth", "3 3 1", "0 0 .012", 2, _EDGES + '<contact selfcollide="none"/>')
    ),
    # Crumpled, so that triangles touch triangles, which both engines find by iterations.
    "cloths that touch themselves": _model(_flex("cloth", "3 3 1", "0 0 .012", 2, _EDGES)),
}


def judged(name: str) -> Verdict:
    """Judge a model of these, in a process where kernels compile in less time."""
    wp.config.optimization_level = 0
    return judge(MODELS[name], kernels="ours", forces=False)
