"""The file of a world whose state became non-finite: its model, its last substeps, and its model fields."""

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import safetensors.numpy
from safetensors import SafetensorError, safe_open

from ksim_rl.files.reading import MOST_DATA_BYTES, check_regular
from ksim_rl.files.writing import whole_file
from ksim_rl.physics.fields import GRAVITY
from ksim_rl.physics.model_checks import model_bytes
from ksim_rl.physics.upstream import per_world_fields
from ksim_rl.physics.views import SUBSTEP_INPUTS

FORMAT = "ksim_rl.nan_guard/2"
_MODEL = "model"
_STATE = "state/"
_FIELD = "field/"
_REACHED = "reached/"


@dataclass(frozen=True, kw_only=True)
class Failure:
    """The last substeps of a world whose state became non-finite in the last of them.

    `states` are before each substep, oldest first, [H, W] each; `reached` is the "qpos" and "qvel" after the last one.
    `fields`, this world's per-world model fields, are not written into `mj_model` yet. `substep` counts all substeps
    since the guard began to watch the world.
    """

    mj_model: mujoco.MjModel
    world: int
    substep: int
    states: Mapping[str, np.ndarray]
    reached: Mapping[str, np.ndarray]
    fields: Mapping[str, np.ndarray]


def write(path: Path, failure: Failure) -> None:
    """Write a failure as safetensors, which are never executed; completely or not at all."""
    tensors = {_MODEL: model_bytes(failure.mj_model)}
    for prefix, arrays in (
        (_STATE, failure.states),
        (_REACHED, failure.reached),
        (_FIELD, failure.fields),
    ):
        tensors |= {
            f"{prefix}{name}": np.ascontiguousarray(array) for name, array in arrays.items()
        }
    # Counters and versions travel as JSON in the header of the file.
    about = {"format": FORMAT, "mujoco": mujoco.__version__}
    about |= {"world": failure.world, "substep": failure.substep, "sha256": _sha256(tensors)}
    data = safetensors.numpy.save(tensors, metadata={"about": json.dumps(about)})
    with whole_file(path) as temporary, open(temporary, "wb") as file:
        file.write(data)
        file.flush()
        # On the disk before the file gets its name, so that a crash leaves no half of it.
        os.fsync(file.fileno())


def read(path: Path) -> Failure:
    """Read a failure back. The model inside is MuJoCo's binary format, which MuJoCo trusts: read your own files only.

    Raises ValueError where the file is none of ours, is damaged, holds other counters, names, shapes or dtypes than the
    guard writes, or was written with another MuJoCo.
    """
    # Before reading: a pipe would never end, and a huge file fill the memory.
    check_regular(path, limit=MOST_DATA_BYTES)
    try:
        # It compares all sizes with the file's before any memory is taken.
        with safe_open(path, framework="numpy") as file:
            about = json.loads((file.metadata() or {}).get("about", "{}"))
            if not isinstance(about, dict) or about.get("format") != FORMAT:
                raise ValueError(f"{path}: not a file of the NaN guard ({FORMAT})")
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, json.JSONDecodeError, OSError) as error:
        raise ValueError(f"{path}: damaged, or not a file of the NaN guard: {error}") from None
    # Before MuJoCo parses the model, whose binary format it trusts.
    if about.get("sha256") != _sha256(tensors):
        raise ValueError(f"{path}: damaged: its numbers are not those that were written")
    # The binary format of models differs from version to version.
    if about.get("mujoco") != mujoco.__version__:
        raise ValueError(
            f"{path}: written with MuJoCo {about.get('mujoco')}; this is {mujoco.__version__}"
        )

    def under(prefix: str) -> dict[str, np.ndarray]:
        return {
            name.removeprefix(prefix): own
            for name, own in tensors.items()
            if name.startswith(prefix)
        }

    try:
        mj_model = mujoco.MjModel.from_binary_path(
            "model.mjb", {"model.mjb": tensors[_MODEL].tobytes()}
        )
        failure = Failure(
            mj_model=mj_model,
            world=about["world"],
            substep=about["substep"],
            states=under(_STATE),
            reached=under(_REACHED),
            fields=under(_FIELD),
        )
        _check(failure)
    except KeyError as error:
        raise ValueError(f"{path}: {error} is missing") from None
    except (ValueError, mujoco.FatalError) as error:
        raise ValueError(f"{path}: {error}") from None
    return failure


def _sha256(tensors: Mapping[str, np.ndarray]) -> str:
    found = hashlib.sha256()
    # Sorted, so that the hash does not depend on the order of the file.
    for name in sorted(tensors):
        found.update(name.encode() + tensors[name].tobytes())
    return found.hexdigest()


def _check(failure: Failure) -> None:
    """Refuse counters, names, shapes and dtypes that no failure of this model has; its numbers may be non-finite."""
    for name, least in (("world", 0), ("substep", 1)):
        value = getattr(failure, name)
        # JSON has booleans, which Python counts as integers: hence the exact type.
        if type(value) is not int or not least <= value < 2**31:
            raise ValueError(f"{name}={value!r}: expected a number from {least} on")
    data = mujoco.MjData(failure.mj_model)
    kept = len(failure.states["qpos"])
    # The sizes that the model's own data have.
    width = {name: np.size(getattr(data, name)) for name in SUBSTEP_INPUTS}
    expected = {f"{_STATE}{name}": (kept, size) for name, size in width.items() if size}
    expected |= {f"{_REACHED}{name}": (width[name],) for name in ("qpos", "qvel")}
    found = {f"{_STATE}{name}": array for name, array in failure.states.items()}
    found |= {f"{_REACHED}{name}": array for name, array in failure.reached.items()}
    if found.keys() != expected.keys():
        raise ValueError(f"expected {', '.join(expected)}; it has {', '.join(found)}")
    for name, array in found.items():
        if array.shape != expected[name] or array.dtype != np.float32:
            raise ValueError(
                f"{name} is {array.dtype} {array.shape}: expected float32 {expected[name]}"
            )
    if not 1 <= kept <= failure.substep:
        raise ValueError(f"{kept} substeps are kept of {failure.substep}")
    for name, array in failure.fields.items():
        if name not in (*per_world_fields(), GRAVITY) or array.dtype not in (np.float32, np.int32):
            raise ValueError(
                f"{_FIELD}{name}, {array.dtype}: no model field that may differ between worlds"
            )
        own = getattr(failure.mj_model, name, None)
        if own is not None and own.size != array.size:
            raise ValueError(f"{_FIELD}{name} has {array.size} numbers: its model has {own.size}")
