"""Writes the model of a scene as one file, with its actuators in the order of the policy's actions."""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from ksim_rl.files.reading import MOST_DATA_BYTES, read_bytes

EXACT = ("gainprm", "biasprm", "dynprm", "ctrlrange", "forcerange", "actrange")

EXACT_OF_KEYS = ("qpos", "qvel", "act", "ctrl", "mpos", "mquat")


def write_robot(
    spec: mujoco.MjSpec, mj_model: mujoco.MjModel, first: Sequence[str], path: Path
) -> list[int]:
    """Write a spec that compiles to `mj_model`, and return its actuators' old ids in their new order.

    The actuators in `first` stand in front, in this order, the others follow. Meshes, height fields and textures are
    copied into the folder `assets` beside the file.
    """
    # The XML has its actuators in the model's order.
    names = [mj_model.actuator(i).name for i in range(mj_model.nu)]
    order = [names.index(name) for name in first]
    order += [i for i in range(mj_model.nu) if i not in order]
    # As text, whose entries can be put into another order and given all digits.
    root = ElementTree.fromstring(spec.to_xml())
    section = root.find("actuator")
    if section is not None:
        entries = list(section)
        for entry in entries:
            section.remove(entry)
        for i in order:
            # MuJoCo writes six digits; gains keep all of theirs.
            for field in EXACT:
                if entries[i].get(field) is not None or field in ("gainprm", "biasprm"):
                    values = getattr(mj_model, f"actuator_{field}")[i]
                    entries[i].set(field, " ".join(repr(float(value)) for value in values))
            section.append(entries[i])
    for number, key in enumerate(root.iter("key")):
        for field in EXACT_OF_KEYS:
            if mj_model.nkey and key.get(field):
                values = getattr(mj_model, f"key_{field}")[number].ravel()
                key.set(field, " ".join(repr(float(value)) for value in values))
        # One number per actuator, so these move along with the actuators.
        if controls := key.get("ctrl"):
            key.set("ctrl", " ".join(np.array(controls.split())[order]))
        if activations := key.get("act"):
            key.set(
                "act", " ".join(np.array(activations.split())[activation_order(mj_model, order)])
            )
    _bring_files(root, Path(spec.modelfiledir), path.parent)
    ElementTree.indent(root)
    path.write_text(ElementTree.tostring(root, encoding="unicode") + "\n")
    return order


def activation_order(mj_model: mujoco.MjModel, order: Sequence[int]) -> list[int]:
    """Return the old places of activations in their new order, for actuators in theirs."""
    # An actuator may have several activations, or none.
    found: list[int] = []
    for actuator in order:
        first = int(mj_model.actuator_actadr[actuator])
        found += range(first, first + int(mj_model.actuator_actnum[actuator]))
    return found


def _bring_files(root: ElementTree.Element, source: Path, folder: Path) -> None:
    # Names of files are relative to folders of this machine, which do not travel along.
    compiler = root.find("compiler")
    if compiler is None:
        folders = {}
    else:
        folders = dict(compiler.attrib)
    # Height fields are looked for where meshes are.
    for tag, directory in (("mesh", "meshdir"), ("hfield", "meshdir"), ("texture", "texturedir")):
        for element in root.iter(tag):
            for field, name in [(k, v) for k, v in element.items() if k.startswith("file")]:
                found = source / folders.get(directory, folders.get("assetdir", "")) / name
                content = read_bytes(found, limit=MOST_DATA_BYTES, follows_links=True)
                # Two files of one name in different folders get different hashes.
                digest = hashlib.sha256(content).hexdigest()[:8]
                copy = Path("assets") / f"{found.stem}_{digest}{found.suffix}"
                (folder / "assets").mkdir(exist_ok=True)
                (folder / copy).write_bytes(content)
                element.set(field, str(copy))
    # The paths are now relative to the model's own folder.
    if compiler is not None:
        for directory in ("meshdir", "texturedir", "assetdir"):
            compiler.attrib.pop(directory, None)
