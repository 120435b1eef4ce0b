"""This module writes and reads the file of a failed world, which has its last substeps and its model as tensors."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import safetensors.numpy
from safetensors import SafetensorError, safe_open

FORMAT = "ksim_rl.nan_guard/1"
_MODEL, _STATE, _FIELD, _REACHED = "model", "state/", "field/", "reached/"


@dataclass(frozen=True, kw_only=True)
class Failure:
    """The last substeps of a world whose state became non-finite in the last of them.

    Args:
        mj_model: the model, before `fields` are written into it.
        world: which of the worlds it was.
        substep: how many substeps the world had done, with the last one, since the guard began to watch it.
        states: state, controls and applied forces before each substep, oldest first, [H, W] each, by MuJoCo's names.
        reached: "qpos" and "qvel" after the last substep: not finite.
        fields: model fields of this world that may differ between worlds.
    """

    mj_model: mujoco.MjModel
    world: int
    substep: int
    states: Mapping[str, np.ndarray]
    reached: Mapping[str, np.ndarray]
    fields: Mapping[str, np.ndarray]


def write(path: Path, failure: Failure) -> None:
    """Write a failure: safetensors, of which nothing is ever executed, completely or not at all."""
    tensors = {_MODEL: _model_bytes(failure.mj_model)}
    for prefix, arrays in ((_STATE, failure.states), (_REACHED, failure.reached), (_FIELD, failure.fields)):
        tensors |= {f"{prefix}{name}": np.ascontiguousarray(array) for name, array in arrays.items()}
    about = {
        "format": FORMAT,
        "mujoco": mujoco.__version__,
        "world": failure.world,
        "substep": failure.substep,
    }
    data = safetensors.numpy.save(tensors, metadata={"about": json.dumps(about)})
    part = path.with_name(f".{path.name}.part")
    with open(part, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    os.replace(part, path)


def read(path: Path) -> Failure:
    """Read a failure back.

    The model inside is MuJoCo's binary format, which MuJoCo trusts: read files of your own only.

    Raises:
        ValueError: if the file is none of ours, is damaged, or its model is of another MuJoCo.
        FileNotFoundError: if there is no such file.
    """
    try:
        with safe_open(path, framework="numpy") as file:
            about = json.loads((file.metadata() or {}).get("about", "{}"))
            if about.get("format") != FORMAT:
                raise ValueError(f"{path}: not a file of the NaN guard ({FORMAT})")
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except SafetensorError as error:
        raise ValueError(f"{path}: damaged, or not a file of the NaN guard: {error}") from None
    if about["mujoco"] != mujoco.__version__:
        raise ValueError(f"{path}: written with MuJoCo {about['mujoco']}; this is {mujoco.__version__}")
    mj_model = mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": tensors[_MODEL].tobytes()})

    def under(prefix: str) -> dict[str, np.ndarray]:
        return {
            name.removeprefix(prefix): array for name, array in tensors.items() if name.startswith(prefix)
        }

    return Failure(
        mj_model=mj_model,
        world=about["world"],
        substep=about["substep"],
        states=under(_STATE),
        reached=under(_REACHED),
        fields=under(_FIELD),
    )


def _model_bytes(mj_model: mujoco.MjModel) -> np.ndarray:
    data = np.empty(mujoco.mj_sizeModel(mj_model), dtype=np.uint8)
    mujoco.mj_saveModel(mj_model, None, data)
    return data
