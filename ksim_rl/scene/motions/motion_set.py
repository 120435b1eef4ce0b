"""Chooses the clips of a reference motion that is a folder, and which of the clips training does not see."""

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np
import torch

from ksim_rl.checked import Checked, Filled, Seed, Share
from ksim_rl.scene.motions.contents import sha256_of
from ksim_rl.scene.motions.motion import ReferenceMotion, load_clips, motion_path
from ksim_rl.scene.names import match_names

MIRRORED = "_mirrored"
"""The end of the name of a motion's mirror image: "kick_high" and "kick_high_mirrored" are twins."""


@dataclass(frozen=True, kw_only=True)
class MotionSet(Checked):
    """Reference motions that are one to the terms of an env, in which each episode follows one clip.

    Clips are named by their files. Held-out clips are evaluated, and no episode of training begins in one; a held-out
    clip takes its mirrored twin along, which would give it away.

    Attributes:
        sources: names of motions that come with the package, .npz files, and folders of these.
        held_out: names of clips that are held out, or regular expressions.
        held_out_share: the share of the other clips that is held out, drawn with `seed`, with twins counted once.
    """

    sources: Annotated[tuple[str, ...], Filled("name a folder of motions, or files")]
    held_out: tuple[str, ...] = ()
    held_out_share: Share = 0.0
    seed: Seed = 0

    def files(self) -> dict[str, str]:
        """Return the files by the names of their clips; a ValueError if a name is there twice, or a folder is empty."""
        found: dict[str, str] = {}
        for source in self.sources:
            for file in _files_of(source):
                name = Path(file).stem
                if name in found:
                    raise ValueError(
                        f"sources: {found[name]} and {file} have the same name {name!r}: rename one of them"
                    )
                found[name] = file
        return found

    def sha256(self) -> str:
        """Return the hash of the clips' names and contents, wherever they lie."""
        total = hashlib.sha256()
        for name, file in self.files().items():
            # Names of files may be no text.
            total.update(os.fsencode(f"{name}\n{sha256_of(motion_path(file))}\n"))
        return total.hexdigest()

    def held_out_of(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return which clips are held out, in their order; a ValueError if none is left to train on."""
        chosen = {names[place] for place in match_names("clip", self.held_out, names)}
        twins = {name.removesuffix(MIRRORED) for name in chosen}
        # Twins are one motion: they are drawn together.
        others = sorted({name.removesuffix(MIRRORED) for name in names} - twins)
        count = round(self.held_out_share * len(others))
        if self.held_out_share > 0.0 and count == 0:
            raise ValueError(
                f"held_out_share={self.held_out_share:g}: of {len(others)} clips that is none: raise it, or set it to 0"
            )
        order = np.random.default_rng(self.seed).permutation(len(others))
        twins |= {others[place] for place in order[:count]}
        held_out = tuple(name for name in names if name.removesuffix(MIRRORED) in twins)
        if len(held_out) == len(names):
            raise ValueError(
                f"held_out={list(self.held_out)}, held_out_share={self.held_out_share:g}: none of the {len(names)} "
                "clips is left to train on: hold out fewer"
            )
        return held_out


def set_of(motions: Mapping[str, MotionSet], file: str) -> MotionSet:
    """Return the set that a term's `file` means: one of a scene's sets by its name, else the file or folder itself."""
    return motions.get(file, MotionSet(sources=(file,)))


def load_set(chosen: MotionSet, mj_model: mujoco.MjModel, device: torch.device) -> ReferenceMotion:
    """Read the motions of a set into one table."""
    files = chosen.files()
    held_out = chosen.held_out_of(list(files))
    return load_clips(files, mj_model, device, held_out=held_out)


def _files_of(source: str) -> list[str]:
    # An empty path would be the working directory.
    if not source:
        raise ValueError("sources: one of them is empty: name a folder of motions, or a file")
    path = motion_path(source)
    if not path.is_dir():
        return [source]
    files = sorted(str(file) for file in path.glob("*.npz"))
    if not files:
        raise ValueError(f"sources: {source}: the folder has no .npz file")
    return files
