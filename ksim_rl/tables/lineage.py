"""Rows that learn from what other rows of their table have left: episodes, networks to begin from, or a teacher."""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from ksim_rl.data import ReplayCfg
from ksim_rl.tables.levels import Result
from ksim_rl.tables.table import Row
from ksim_rl.trainers import RunCfg

# In the run folder of a seed.
EPISODES = "demonstration"
SUCCESS = "evaluation/metric/"


def sources_of(row: Row) -> list[str]:
    """Return the names of the rows that have to be there before it."""
    return [name for name in (row.learns_from, row.begins_from, row.taught_by) if name]


def depth_of(rows: Mapping[str, Row], name: str) -> int:
    """Return how many rows have to be there one after the other before this one."""
    below = [depth_of(rows, source) for source in sources_of(rows[name])]
    return 1 + max(below, default=-1)


def overrides_of(row: Row) -> list[str]:
    """Return the overrides that name what a row learns from.

    Rows stand for their folders, so that a fingerprint is the same on every machine; `with_sources` finds the folders.
    """
    words = []
    if row.begins_from:
        words.append(f"checkpoint={row.begins_from!r}")
    if row.taught_by:
        words.append(f"objective.teacher={row.taught_by!r}")
    if row.learns_from:
        episodes = f"{row.learns_from}/{EPISODES}"
        if row.objective == "bc":
            words.append(f"objective.episodes={episodes!r}")
        else:
            # As a whole, since there is no field of it before.
            words.append(f"data.offline={{source: {episodes!r}}}")
    return words


def with_sources(cfg: RunCfg, row: Row, folders: Mapping[str, Path]) -> RunCfg:
    """Return the config of a row with the run folders of the rows that it learns from, in place of their names."""
    # The fields of `overrides_of`: nothing else of the config differs from the one that has names.
    if row.begins_from:
        cfg = replace(cfg, checkpoint=str(folders[row.begins_from]))
    if row.taught_by:
        taught = {"teacher": str(folders[row.taught_by])}
        cfg = replace(cfg, objective=replace(cfg.objective, **taught))
    if row.learns_from:
        episodes = str(folders[row.learns_from] / EPISODES)
        if row.objective == "bc":
            shown = {"episodes": episodes}
            cfg = replace(cfg, objective=replace(cfg.objective, **shown))
        else:
            assert isinstance(cfg.data, ReplayCfg)
            assert cfg.data.offline is not None
            offline = replace(cfg.data.offline, source=episodes)
            cfg = replace(cfg, data=replace(cfg.data, offline=offline))
    return cfg


def run_of(runs: Path, name: str, seed: int) -> Path:
    """Return the run folder of a row and seed."""
    return runs / name / f"seed_{seed}"


def runs_of(run_folder: Path, name: str) -> Path:
    """Return the folder of all runs of a table, from the run folder of a seed of a row."""
    return run_folder.parents[len(Path(name).parts)]


def lineage_figures(
    rows: Mapping[str, Row], results: Mapping[str, Sequence[Result]]
) -> dict[str, float]:
    """Return figures by name of row or group: `<row>_success`, `<row>/share_of_teacher`, `<group>/env_states_saved`.

    Success is of the final evaluation and the worst seed, for rows that learn from episodes. The share of a teacher is
    the success on the row's course over its teacher's on its own, in the mean over kinds of ground and levels, and the
    worst seed's; a teacher that arrives nowhere gives none. Saved are the env states
    that the row `saves_over` needs to reach its levels, minus the env states that this row needs, of all runs
    that it begins from, and the episodes that these learned from: a median over the seeds. An infinite value has no
    figure.
    """
    figures: dict[str, float] = {}
    for name, own in results.items():
        row = rows[name]
        if row.learns_from:
            for level in row.levels:
                if level.startswith(SUCCESS):
                    worst = min(result["means"].get(level, 0.0) for result in own)
                    figures[f"{name}_success"] = round(worst, 4)
        if row.taught_by in results:
            shares = _shares_of_teacher(own, results[row.taught_by])
            if shares:
                figures[f"{name}/share_of_teacher"] = round(min(shares), 4)
        if row.saves_over in results:
            saved = _saved(rows, results, name)
            if math.isfinite(saved):
                group = name.rpartition("/")[0]
                figures[f"{group}/env_states_saved".strip("/")] = saved
    return figures


def _shares_of_teacher(results: Sequence[Result], teachers: Sequence[Result]) -> list[float]:
    """Return the shares, seed by seed, or none where one of them has no course, or a teacher arrives nowhere."""
    shares = []
    for own, teacher in zip(results, teachers, strict=True):
        if "course" not in own or "course" not in teacher:
            return []
        reachable = teacher["course"]["success"]
        if not reachable:
            return []
        shares.append(own["course"]["success"] / reachable)
    return shares


def _saved(rows: Mapping[str, Row], results: Mapping[str, Sequence[Result]], name: str) -> float:
    taken = [_to_levels(result) for result in results[name]]
    # All that had to be there before, seed by seed.
    source = rows[name].begins_from
    while source:
        # A source without results would count as nothing.
        if source not in results:
            return math.inf
        taken = [
            all_in + own["env_states"] for all_in, own in zip(taken, results[source], strict=True)
        ]
        recorded = rows[source].learns_from
        if recorded:
            shown = [own["recorded_env_states"] for own in results.get(recorded, ())]
            if len(shown) < len(taken):
                return math.inf
            taken = [all_in + own for all_in, own in zip(taken, shown, strict=True)]
        source = rows[source].begins_from
    alone = [_to_levels(result) for result in results[rows[name].saves_over]]
    return statistics.median(alone) - statistics.median(taken)


def _to_levels(result: Result) -> float:
    found = result["env_states_to_levels"]
    if found is None:
        return math.inf
    return found
