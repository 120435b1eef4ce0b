"""This module finds the run folder that a command names: one on this disk, of the zoo, or of Weights & Biases."""

import shutil
from collections.abc import Callable
from pathlib import Path

from ksim_rl.zoo import wandb_runs
from ksim_rl.zoo.cards import CHECKPOINT, FOLDER, read_card


def locate(text: str | Path, *, note: Callable[[str], None] = print) -> Path:
    """Return a run folder: `zoo:NAME` and `wandb:ENTITY/PROJECT/RUN` are copied into `runs/zoo` and `runs/wandb`.

    Any other text is a path. What is copied is data, checked by hash; a ValueError says what is wrong with it.
    """
    kind, colon, name = str(text).partition(":")
    if not colon or kind not in ("zoo", "wandb"):
        return Path(text)
    if kind == "wandb":
        return wandb_runs.download(name, Path("runs/wandb"), note=note)
    card = read_card(name, FOLDER)
    copy = Path("runs/zoo") / name
    shutil.rmtree(copy / CHECKPOINT, ignore_errors=True)
    shutil.copytree(FOLDER / name, copy, dirs_exist_ok=True)
    note(f"{text}: {card.task}, {card.env_states:,} env states; copied to {copy}")
    return copy
