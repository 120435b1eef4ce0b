"""Makes an entry of the zoo out of a run folder."""

import json
import math
import re
import shutil
from dataclasses import asdict, replace
from pathlib import Path

from ksim_rl.device.state_tree import branch, tensors
from ksim_rl.export import export, sim2sim
from ksim_rl.files.writing import unfinished_folder
from ksim_rl.runs import listing, record
from ksim_rl.runs.csv_table import STEP
from ksim_rl.terminal import show
from ksim_rl.trainers import checkpoint
from ksim_rl.trainers.run_cfg import check_run_tree
from ksim_rl.zoo.cards import CARD, CHECKPOINT, FOLDER, MOST_BYTES, ONNX, Card, hashes, read_card

NAME = re.compile(r"[a-z0-9][a-z0-9_]*", re.ASCII)
CURVE_POINTS = 24
RETURN = "episode/return"


def add(run: Path, name: str, *, folder: Path = FOLDER, episodes: int = 100) -> Card:
    """Make an entry out of a run folder, with `episodes` compared with MuJoCo's C engine, and return its card.

    Matrices are rounded to float16, and the rounded policy is compared. Raises ValueError for a wrong name, a
    run of code that is not in one commit, rewards that cannot be compared, and more than 200 kB.
    """
    if not NAME.fullmatch(name):
        raise ValueError(f"{name!r}: expected lower-case letters, digits and _")
    if (folder / name).exists():
        raise ValueError(f"{folder / name} exists: delete it, or choose another name")
    saved = checkpoint.load_latest(run)
    check_run_tree(saved.config, saved.path)
    card = _of_run(saved, name=name)
    folder.mkdir(parents=True, exist_ok=True)
    # In a folder beside: the entry appears once it is whole and its figures are there.
    with unfinished_folder(folder) as temporary:
        entry = temporary / name
        exported = temporary / "export"
        # The actor is all that playing needs, and matrices in half precision halve its size.
        with checkpoint.fitting(saved.path):
            actor = tensors(branch(branch(saved.state, "update"), "actor"))
            actor |= {
                key: x.half() for key, x in actor.items() if x.is_floating_point() and x.ndim > 1
            }
            state = {
                "observation_columns": saved.state["observation_columns"],
                "update": {"actor": actor},
            }
        entry.mkdir()
        checkpoint.save(entry / CHECKPOINT, state, iteration=saved.iteration, config=saved.config)
        # Of the training, not of this command.
        made = {"commit": card.commit, "versions": dict(record.read(run)[-1].versions)}
        export(entry, exported, episodes=episodes, note=show, origin=made)
        # The rounded policy is compared, since users get that one.
        report = sim2sim(exported, episodes=episodes, note=show)
        if not math.isfinite(report.return_ratio):
            raise ValueError(f"{run}: of its rewards none has a description; see docs/deploy.md")
        # The network in ONNX is the one that was compared.
        shutil.copyfile(exported / ONNX, entry / ONNX)
        ratio = {"return_ratio": report.return_ratio, "standard_error": report.standard_error}
        # Hashes of all files but the card, which holds them.
        card = replace(card, sim2sim={**ratio, "episodes": float(episodes)}, files=hashes(entry))
        (entry / CARD).write_text(json.dumps(asdict(card), indent=1) + "\n")
        if (
            size := sum(path.stat().st_size for path in entry.rglob("*") if path.is_file())
        ) > MOST_BYTES:
            raise ValueError(f"{run}: {size:,} bytes, above {MOST_BYTES:,}: train a smaller actor")
        entry.rename(folder / name)
    return read_card(name, folder)


def _of_run(saved: checkpoint.Checkpoint, *, name: str) -> Card:
    """Return the card of a run as its folder tells."""
    run = saved.run_folder
    summary = listing.summarize(saved.run_folder)
    codes = [session.code.get("ksim_rl", {}) for session in record.read(run)] or [{}]
    # A run that was resumed may have been made by several commits.
    made = {
        code.get("commit", "no commit") + " with changes" * ("changed" in code) for code in codes
    }
    commit = " and ".join(sorted(made))
    # Only a clean commit can be repeated.
    if not re.fullmatch("[0-9a-f]{40}", commit):
        raise ValueError(
            f"{run}: made of {commit}: train in a clean clone of one commit, and add that run"
        )
    rows = listing.metric_rows(run)
    earned = []
    for row in rows:
        # One number, or none where the row has no return.
        for value in listing.numbers([row], RETURN):
            earned.append((int(row[STEP]), value))
    # Every so many points, so that the card stays small.
    earned = earned[:: max(1, len(earned) // CURVE_POINTS)]
    return Card(
        name=name,
        task=str(saved.config["task_name"]),
        commit=commit,
        seed=int(saved.config["seed"]),
        num_envs=int(saved.config["num_envs"]),
        iteration=saved.iteration,
        env_states=summary.env_states or 0,
        return_mean=summary.evaluation,
        curve=tuple((step, float(f"{value:.4g}")) for step, value in earned),
    )
