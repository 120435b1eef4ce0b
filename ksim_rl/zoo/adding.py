"""This module makes an entry of the zoo out of a run folder."""

import json
import re
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path

from ksim_rl.export import export, sim2sim
from ksim_rl.runs import csv_table, listing, record
from ksim_rl.trainers import checkpoint
from ksim_rl.trainers.run_cfg import check_run_tree
from ksim_rl.zoo.cards import CARD, CHECKPOINT, FOLDER, MOST_BYTES, ONNX, Card, hashes, read_card

NAME = re.compile(r"[a-z0-9][a-z0-9_]*", re.ASCII)
CURVE_POINTS = 24


def add(
    run: Path, name: str, *, folder: Path = FOLDER, episodes: int = 100, note: Callable[[str], None] = print
) -> Card:
    """Make an entry out of a run folder, and return its card.

    `episodes` are compared with MuJoCo's C engine. Raises ValueError for a wrong name, and more than 200 kB.
    """
    if not NAME.fullmatch(name):
        raise ValueError(f"{name!r}: expected lower-case letters, digits and _")
    if (folder / name).exists():
        raise ValueError(f"{folder / name} exists: delete it, or choose another name")
    saved = checkpoint.load_latest(run)
    check_run_tree(saved.config, saved.path)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        entry, exported = Path(temporary) / name, Path(temporary) / "export"
        export(run, exported, episodes=episodes, note=note)
        report = sim2sim(exported, episodes=episodes, note=note)
        entry.mkdir()
        shutil.copyfile(exported / ONNX, entry / ONNX)
        actor = {"actor": saved.state["update"]["actor"]}
        state = {"observation_columns": saved.state["observation_columns"], "update": actor}
        checkpoint.save(entry / CHECKPOINT, state, iteration=saved.iteration, config=saved.config)
        compared = {"return_ratio": report.return_ratio, "standard_error": report.standard_error}
        card = _of_run(saved, name=name, compared={**compared, "episodes": float(episodes)})
        card = replace(card, files=hashes(entry))
        (entry / CARD).write_text(json.dumps(asdict(card), indent=1) + "\n")
        size = sum(path.stat().st_size for path in entry.rglob("*") if path.is_file())
        if size > MOST_BYTES:
            fix = "train smaller networks, modules.actor.hidden_dims=[64,64]"
            raise ValueError(f"{run}: {size:,} bytes, above the {MOST_BYTES:,} of an entry: {fix}")
        entry.rename(folder / name)
    return read_card(name, folder)


def _of_run(saved: checkpoint.Checkpoint, *, name: str, compared: Mapping[str, float]) -> Card:
    """Return the card of a run as its folder tells."""
    summary, sessions = listing.summarize(saved.run_folder), record.read(saved.run_folder)
    code = sessions[0].code.get("ksim_rl", {}) if sessions else {}
    _, rows = csv_table.read_table(saved.run_folder / listing.METRICS)
    earned = [row for row in rows if listing.numbers([row], "episode/return")]
    curve = [(int(row[csv_table.STEP]), float(f"{float(row['episode/return']):.4g}")) for row in earned]
    return Card(
        name=name,
        task=str(saved.config["task_name"]),
        commit=code.get("commit", "unknown") + "-dirty" * ("changed" in code),
        seed=int(saved.config["seed"]),
        num_envs=int(saved.config["num_envs"]),
        iteration=saved.iteration,
        env_states=summary.env_states or 0,
        return_mean=summary.evaluation,
        curve=tuple(curve[:: max(1, len(curve) // CURVE_POINTS)]),
        sim2sim=compared,
    )
