"""This module writes the model of a scene as one file, with its actuators in the order of the policy's actions."""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from ksim_rl.files.reading import MOST_DATA_BYTES, read_bytes

EXACT = ("gainprm", "biasprm", "dynprm", "ctrlrange", "forcerange", "actrange")


def write_robot(spec: mujoco.MjSpec, mj_model: mujoco.MjModel, first: Sequence[str], path: Path) -> list[int]:
    """Write a spec that compiles to `mj_model`, and return its actuators' old ids in their new order.

    The actuators in `first` stand in front, in this order, the others follow. Meshes, height fields and textures are
    copied into the folder `assets` beside the file.
    """
    names = [mj_model.actuator(i).name for i in range(mj_model.nu)]
    order = [names.index(name) for name in first]
    order += [i for i in range(mj_model.nu) if i not in order]
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
    for key in root.iter("key"):
        if controls := key.get("ctrl"):
            key.set("ctrl", " ".join(np.array(controls.split())[order]))
        if mj_model.na and key.get("act") and order != sorted(order):
            raise ValueError("the keyframe's activations stand in another order: leave `act` out of it")
    _bring_files(root, Path(spec.modelfiledir), path.parent)
    ElementTree.indent(root)
    path.write_text(ElementTree.tostring(root, encoding="unicode") + "\n")
    return order


def _bring_files(root: ElementTree.Element, source: Path, folder: Path) -> None:
    compiler = root.find("compiler")
    folders = {} if compiler is None else dict(compiler.attrib)
    for tag, directory in (("mesh", "meshdir"), ("hfield", "meshdir"), ("texture", "texturedir")):
        for element in root.iter(tag):
            for field, name in [(k, v) for k, v in element.items() if k.startswith("file")]:
                found = source / folders.get(directory, folders.get("assetdir", "")) / name
                content = read_bytes(found, limit=MOST_DATA_BYTES, follows_links=True)
                digest = hashlib.sha256(content).hexdigest()[:8]
                copy = Path("assets") / f"{found.stem}_{digest}{found.suffix}"
                (folder / "assets").mkdir(exist_ok=True)
                (folder / copy).write_bytes(content)
                element.set(field, str(copy))
    if compiler is not None:
        for directory in ("meshdir", "texturedir", "assetdir"):
            compiler.attrib.pop(directory, None)
