"""A soak of a task in which a mesh swings before a camera, whose pictures the policy sees."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
from jaxtyping import Float
from torch import Tensor

from benchmarks.faults import growth
from benchmarks.faults.row import AT_MOST, Figures, Row
from ksim_rl.envs.term import ObservationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.scene.robots import Cartpole
from ksim_rl.scene.sensors import CameraSensor
from ksim_rl.trainers import RunCfg
from ksim_rl.transforms import ObservationTermCfg

# Four triangles, in m.
WEDGE = (0.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 0.2)
EYE = CameraSensor(pos=(-2.0, 0.0, 1.0), width=8, height=8, rgb=False, depth=True)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CartpoleWithWedge(Cartpole):
    """The cartpole, and beside it a mesh that swings about an axis of its own."""

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        spec = super().spec()
        mesh = spec.add_mesh(name="wedge")
        mesh.uservert = list(WEDGE)
        body = spec.worldbody.add_body(name="wedge", pos=[0.0, 1.0, 1.0])
        body.add_joint(name="swing", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[1.0, 0.0, 0.0])
        body.add_geom(name="wedge", type=mujoco.mjtGeom.mjGEOM_MESH, meshname="wedge", mass=0.1)
        return spec


@dataclasses.dataclass(frozen=True, kw_only=True)
class Depths(ObservationTerm):
    """Depths of all pixels, m, as one vector, which a policy takes beside others."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.camera("eye").depth_EHW.flatten(1)


def with_mesh_and_camera(cfg: RunCfg) -> RunCfg:
    """Return a run's config with a mesh in its scene, and a camera that its policy reads."""
    scene = dataclasses.replace(
        cfg.task.scene, robots={"cartpole": CartpoleWithWedge()}, sensors={"eye": EYE}
    )
    picture = ObservationTermCfg(term=Depths())
    groups = {}
    for name, group in cfg.task.observations.items():
        groups[name] = dataclasses.replace(group, terms={**group.terms, "picture": picture})
    return dataclasses.replace(
        cfg, task=dataclasses.replace(cfg.task, scene=scene, observations=groups)
    )


def seen_soak(folder: Path, *, iterations: int, **_: int) -> Figures:
    """Train with a mesh and a camera, and look for growth."""
    return growth.soak(folder, iterations=iterations, change=with_mesh_and_camera)


ROWS = {
    "seen_soak": Row(
        fault="2,000 iterations of a task with a mesh, and a camera that the policy reads, with logs and checkpoints",
        must="memory of the host flat; open files, threads and files bounded",
        limits={**growth.LIMITS, "files_rise": (AT_MOST, "most_files")},
        measure=seen_soak,
        # A megabyte over the whole run: the pages that an allocator takes by and by count for more in a shorter one.
        amounts={"iterations": 2000, "most_bytes": 500, "most_blocks": 3, "most_files": 0},
        short={"iterations": 100, "most_bytes": 100_000, "most_blocks": 15, "most_files": 2},
        files=(
            *growth.ROWS["soak"].files,
            "ksim_rl/scene/sensors/camera.py",
            "ksim_rl/physics/ray_casting.py",
        ),
    ),
}
