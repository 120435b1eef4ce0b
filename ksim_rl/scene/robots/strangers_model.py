"""Reads the model of a robot that nobody here has seen, and readies it for an analysis."""

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from ksim_rl.physics import load_model, load_spec
from ksim_rl.physics.load import Source
from ksim_rl.physics.model_files.source import is_xml, read_source
from ksim_rl.physics.model_files.urdf import is_urdf
from ksim_rl.scene.names import TO_JOINTS
from ksim_rl.scene.robots.edit import reset_options
from ksim_rl.scene.robots.upright_root import (
    UPRIGHT,
    Quaternion,
    fixed_root,
    free_root,
    name_all,
    turn_of_root,
    turn_root,
)


@dataclass(frozen=True, kw_only=True)
class StrangersModel:
    """A model with names for all, a free root, and the task's options; `source` is what `load_spec` takes of it.

    `frees_root` and `root_turn` are what was done to it, as `ModelRobot` has them, and `notes` say so.
    """

    name: str
    source: str
    spec: mujoco.MjSpec
    mj_model: mujoco.MjModel
    notes: tuple[str, ...]
    frees_root: bool = False
    root_turn: Quaternion = UPRIGHT

    def turned_upright(self, qpos: np.ndarray) -> tuple["StrangersModel", np.ndarray]:
        """Return the model whose root has its z axis upwards in the pose `qpos`, and the pose in that model."""
        joint = int(self.mj_model.jnt_type.argmin())
        first = int(self.mj_model.jnt_qposadr[joint])
        quat = qpos[first + 3 : first + 7]
        turn = turn_of_root(quat)
        if turn == UPRIGHT:
            return self, qpos
        root = self.mj_model.body(self.mj_model.jnt_bodyid[joint]).name
        spec = self.spec.copy()
        turn_root(spec, root, turn)
        turned = qpos.copy()
        mujoco.mju_mulQuat(turned[first + 3 : first + 7], quat, np.array(turn))
        note = f"the frame of {root} is turned so that its z axis points up in the stance"
        model = dataclasses.replace(
            self, spec=spec, mj_model=load_model(spec), root_turn=turn, notes=(*self.notes, note)
        )
        return model, turned


def read_model(source: Source) -> StrangersModel:
    """Read a robot's model from what `load_spec` takes; a URDF file's base is freed, since URDF cannot say so."""
    spec = load_spec(source)
    name = robot_name(source, spec)
    if isinstance(source, mujoco.MjSpec):
        given = _as_text(spec)
    else:
        given = str(source)
    notes = []
    # The task has options of its own, so that those of the file need not be any that can be simulated here.
    reset_options(spec)
    if named := name_all(spec):
        notes.append(f"no names, so they get these: {', '.join(named)}")
    root = fixed_root(spec)
    frees = root is not None and not isinstance(source, mujoco.MjSpec) and is_urdf(read_source(source).text)
    if frees:
        assert root is not None
        free_root(spec, root)
        notes.append(f"the base {root} is freed: the URDF file fixes it to the world")
    others = [actuator.name or "unnamed" for actuator in spec.actuators if actuator.trntype not in TO_JOINTS]
    if others:
        notes.append(
            f"servos of joints take the place of actuators of tendons, sites and bodies: {', '.join(others)}"
        )
    return StrangersModel(
        name=name,
        source=given,
        spec=spec,
        mj_model=load_model(spec),
        notes=tuple(notes),
        frees_root=frees,
    )


def robot_name(source: Source, spec: mujoco.MjSpec | None = None) -> str:
    """Return what a robot is called: its file without the suffix, or what the model calls itself.

    A scene that cannot be read is called like its folder: what is wrong with it is told where the model is needed.
    """
    is_file = not isinstance(source, mujoco.MjSpec) and not is_xml(source)
    called = Path(source).stem if is_file else "scene"
    if called == "scene":
        try:
            called = (spec or load_spec(source)).modelname
        except ValueError:
            if is_file:
                called = Path(source).absolute().parent.name
            else:
                called = "robot"
    return re.sub(r"\W+", "_", called.lower()) or "robot"


def _as_text(spec: mujoco.MjSpec) -> str:
    """Return the spec as XML whose files are found from anywhere."""
    spec = spec.copy()
    spec.compile()
    folder = Path(spec.modelfiledir or ".").resolve()
    spec.meshdir, spec.texturedir = str(folder / spec.meshdir), str(folder / spec.texturedir)
    return spec.to_xml()
