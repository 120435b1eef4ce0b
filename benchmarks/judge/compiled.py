"""Compiles a model with the fields of one world, as if its XML had them."""

import mujoco
import numpy as np

from ksim_rl.physics import SimCfg, load_spec
from ksim_rl.physics.load import caught_warnings

# What no physics reads, or what C's compiler and mj_setConst lay out in other ways that mean the same.
_LAID_OUT = (
    "key_",
    "bvh_",
    "oct_",
    "mesh_",
    "hfield_",
    "tex_",
    "mat_",
    "skin_",
    "flex",
    "light_",
    "cam_",
)
_ROUNDING = 1e-5


def compiled_with(xml: str, sim: SimCfg, world_model: mujoco.MjModel) -> mujoco.MjModel | None:
    """Return what C compiles from a model with the fields of a world.

    None where no XML says these fields, such as another damping of each axis of a ball, or where they mean something
    else to the compiler, which takes inertias from geoms and poses of free bodies from their body.

    Args:
        xml: the model as all worlds have it.
        sim: what is laid over its options.
        world_model: the model with the fields of the world written into it.
    """
    spec = load_spec(xml)
    sim.apply_to(spec)
    with caught_warnings():
        spec.compile()
        try:
            spec.copy_back(world_model)
            _give_bodies(spec, world_model)
            compiled = spec.compile()
        except ValueError:
            return None
    return compiled if _mean_the_same(compiled, world_model) else None


def _give_bodies(spec: mujoco.MjSpec, world_model: mujoco.MjModel) -> None:
    """Write what MuJoCo does not copy back: inertias that its compiler would take from geoms, and gravcomp."""
    for body in spec.bodies[1:]:
        number = body.id
        body.explicitinertial = True
        body.mass = float(world_model.body_mass[number])
        body.ipos = world_model.body_ipos[number]
        body.iquat = world_model.body_iquat[number]
        body.inertia = world_model.body_inertia[number]
        body.gravcomp = float(world_model.body_gravcomp[number])


def _mean_the_same(compiled: mujoco.MjModel, world_model: mujoco.MjModel) -> bool:
    """Whether all that a world may differ in came through the compiler as it was."""
    if compiled.nv != world_model.nv or compiled.ngeom != world_model.ngeom:
        return False
    for name in dir(world_model):
        if name.startswith(("_", *_LAID_OUT)):
            continue
        wanted = getattr(world_model, name)
        if not isinstance(wanted, np.ndarray) or wanted.dtype.kind != "f":
            continue
        found = getattr(compiled, name)
        if found.shape != wanted.shape or not np.allclose(
            found, wanted, rtol=_ROUNDING, atol=_ROUNDING
        ):
            return False
    return True
