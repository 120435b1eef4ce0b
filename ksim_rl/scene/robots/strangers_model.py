"""Reads the model of an unknown robot, and prepares it for an analysis."""

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from ksim_rl.physics import load_model, load_spec
from ksim_rl.physics.load import Source
from ksim_rl.physics.model_files.source import is_xml, read_source
from ksim_rl.physics.model_files.urdf import is_urdf
from ksim_rl.scene.names import TO_JOINTS
from ksim_rl.scene.robots.edit import drop_bodies, reset_options
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
    """A model with names for all, a free root, and the task's options; `source` is its source for `load_spec`.

    `dropped`, `frees_root` and `root_turn` are changes to it, as `ModelRobot` has them, and `notes` say so.
    """

    name: str
    source: str
    spec: mujoco.MjSpec
    mj_model: mujoco.MjModel
    notes: tuple[str, ...]
    dropped: tuple[str, ...] = ()
    frees_root: bool = False
    root_turn: Quaternion = UPRIGHT

    def turned_upright(self, qpos: np.ndarray) -> tuple["StrangersModel", np.ndarray]:
        """Return the model whose root has its z axis upwards in the pose `qpos`, and the pose in that model."""
        # The free joint has the lowest joint type, 0.
        joint = int(self.mj_model.jnt_type.argmin())
        first = int(self.mj_model.jnt_qposadr[joint])
        quat = qpos[first + 3 : first + 7]
        turn = turn_of_root(quat)
        if turn == UPRIGHT:
            return self, qpos
        root = self.mj_model.body(self.mj_model.jnt_bodyid[joint]).name
        # A copy, since other poses may need other turns.
        spec = self.spec.copy()
        turn_root(spec, root, turn)
        turned = qpos.copy()
        # The same pose in the world, with the new axes.
        mujoco.mju_mulQuat(turned[first + 3 : first + 7], quat, np.array(turn))
        note = f"the frame of {root} is turned so that its z axis points up in the stance"
        model = dataclasses.replace(
            self, spec=spec, mj_model=load_model(spec), root_turn=turn, notes=(*self.notes, note)
        )
        return model, turned


def read_model(source: Source, drop: Sequence[str] = ()) -> StrangersModel:
    """Read a robot's model from a source for `load_spec`, without some bodies.

    A URDF file's base is freed, since URDF cannot say that it is free.
    """
    spec = load_spec(source)
    name = robot_name(source, spec)
    # A spec has no file that could be named again, so its text is kept.
    if isinstance(source, mujoco.MjSpec):
        given = _as_text(spec)
    else:
        given = str(source)
    notes = []
    # The task has options of its own, so that the file's options need not be any that can be simulated here.
    reset_options(spec)
    if named := name_all(spec):
        notes.append(f"no names, so they get these: {', '.join(named)}")
    drop_bodies(spec, drop)
    if drop:
        notes.append(f"left out, with all that hangs on them: {', '.join(drop)}")
    # Only URDF cannot say that its base is free; a fixed MJCF model is meant to be.
    root = fixed_root(spec)
    frees = (
        root is not None
        and not isinstance(source, mujoco.MjSpec)
        and is_urdf(read_source(source).text)
    )
    if frees:
        assert root is not None
        free_root(spec, root)
        notes.append(f"the base {root} is freed: the URDF file fixes it to the world")
    # Velocity tasks drive joints only.
    others = [
        actuator.name or "unnamed"
        for actuator in spec.actuators
        if actuator.trntype not in TO_JOINTS
    ]
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
        dropped=tuple(drop),
        frees_root=frees,
    )


def robot_name(source: Source, spec: mujoco.MjSpec | None = None) -> str:
    """Return the name of a robot: its file without the suffix, or the model's own name.

    A scene that cannot be read is called like its folder: the error comes where the model is needed.
    """
    is_file = not isinstance(source, mujoco.MjSpec) and not is_xml(source)
    called = Path(source).stem if is_file else "scene"
    # Menagerie folders have a "scene.xml" each, which names no robot.
    if called == "scene":
        try:
            called = (spec or load_spec(source)).modelname
        except ValueError:
            if is_file:
                called = Path(source).absolute().parent.name
            else:
                called = "robot"
    # Names become parts of identifiers and files.
    return re.sub(r"\W+", "_", called.lower()) or "robot"


def _as_text(spec: mujoco.MjSpec) -> str:
    """Return the spec as XML whose files are found from anywhere."""
    spec = spec.copy()
    # Compiling resolves the folder of the model's files.
    spec.compile()
    folder = Path(spec.modelfiledir or ".").resolve()
    # Absolute folders, since the text is read from elsewhere.
    spec.meshdir = str(folder / spec.meshdir)
    spec.texturedir = str(folder / spec.texturedir)
    return spec.to_xml()
