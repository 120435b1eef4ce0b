"""Finds the run folder that a command names: one on this disk, of the zoo, or of Weights & Biases."""

import shutil
from collections.abc import Callable
from pathlib import Path

from ksim_rl.files.writing import check_folder, whole_folder
from ksim_rl.terminal import show
from ksim_rl.zoo import wandb_runs
from ksim_rl.zoo.cards import CHECKPOINT, FOLDER, read_card


def locate(text: str | Path, *, note: Callable[[str], None] = show) -> Path:
    """Return a run folder: `zoo:NAME` and `wandb:ENTITY/PROJECT/RUN` are copied into `runs/zoo` and `runs/wandb`.

    Any other text is a path. The copy is data, checked by hash; a ValueError names its fault.
    """
    kind, colon, name = str(text).partition(":")
    # A path with a colon in it is still a path.
    if not colon or kind not in ("zoo", "wandb"):
        return Path(text)
    if kind == "wandb":
        return wandb_runs.download(name, Path("runs/wandb"), note=note)
    card = read_card(name, FOLDER)
    copy = Path("runs/zoo") / name
    runs = Path("runs")  # which may be a link of the user's, to a larger disk
    check_folder(copy / CHECKPOINT, below=runs)
    # The checkpoint of an older package must not stay beside the new one.
    shutil.rmtree(copy / CHECKPOINT, ignore_errors=True)
    with whole_folder(copy, below=runs) as unfinished:
        shutil.copytree(FOLDER / name, unfinished, dirs_exist_ok=True)
    note(f"{text}: {card.task}, {card.env_states:,} env states; copied to {copy}")
    return copy
