"""Trains one seed of a row, judges its final policy, and writes the result.

    python -m ksim_rl.tables.measure TABLE ROW SEED RESULT RUN_FOLDER DEVICE [smoke]

is a process of its own for each, which `ksim-rl reproduce` starts.
"""

import hashlib
import json
import os
import re
import shutil
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from tensordict.nn import TensorDictModuleBase

from ksim_rl import conf
from ksim_rl.checks import check_in_range, naming
from ksim_rl.config import plugins
from ksim_rl.config.child_processes import go_to_parents_folder
from ksim_rl.config.class_paths import MOVED_CLASSES
from ksim_rl.config.trees import Tree
from ksim_rl.device.kernel_loading import compile_notice
from ksim_rl.envs.contract import EpisodeSums, part
from ksim_rl.files.writing import write_whole
from ksim_rl.runs import record
from ksim_rl.runs.csv_table import read_table, thinned
from ksim_rl.runs.listing import METRICS
from ksim_rl.tables.inputs import (
    FilesHere,
    Sources,
    clear_finished,
    files_read,
    hashes_of,
    write_finished,
)
from ksim_rl.tables.levels import HELD_STATES, Result, means_of, reached
from ksim_rl.tables.lineage import EPISODES, overrides_of, runs_of, sources_of, with_sources
from ksim_rl.tables.table import COURSE_LEAST, Row, load
from ksim_rl.tasks.terrain_course import (
    GROUND_SEED,
    ROBOT_SEED,
    SPEED,
    course_of,
    summary,
    walk,
)
from ksim_rl.terminal import show
from ksim_rl.tracking.trials import run_trials
from ksim_rl.trainers import Hook, RunCfg, RunProgress, Trainer, run
from ksim_rl.trainers.collecting import CollectCfg, collect_episodes
from ksim_rl.trainers.kept_models import ReadFile
from ksim_rl.trainers.run_cfg import reaching_outside
from ksim_rl.trainers.run_folder import Policy

# Points of a curve: enough to draw it, few enough for a file in the repository.
KEPT_POINTS = 60
# One evaluation, at the end, of the final policy.
FIXED = "trainer.eval_interval=0 trainer.checkpoint_interval=0 trainer.stop_when_solved=false logger=local"
# The level of a row whose task holds clips out: the mean share of their trials that succeed.
HELD_OUT = "evaluation/held_out_success"
# Two iterations and a few short episodes say whether all parts of a row work, and nothing about how well it learns.
SMOKE = "num_envs=8 data.num_env_states_per_minibatch=32 data.num_minibatches=2 task.episode_length_s=0.4"
SMOKE_EPISODES = 4
# Whoever shows how a task is done does so from other initial states than are trained or evaluated in.
RECORDED_SEED_OFFSET = 2_000_003
RECORDED_ENVS = 64  # at the same time
# About 51 on each kind of ground at each level: nine of ten are then told from eight of ten.
COURSE_ROBOTS = 4096
# Fields that came after the first tables, with values that change nothing, as a fingerprint's text has them.
LATER = re.compile(
    '"min_advantage_std": 0.0001, |"min_std": 0.001, |"engine": "auto", |"eager": false, '
    r'|"about": "both", |"along": "vertical", |"value_lmbda": null, '
    r'|"dropped": \[\], |"rel_world_envs": 0.0, |"lag_group": "", |"per_substep": false, '
    # Of an ActuatorAction, whose last field is its scale.
    r'|"offset": 0.0, (?="scale": [^,{}]*\})'
    # Of the networks of off-policy methods, which read one group before they could choose.
    r'|"encoders": \{\}, |"in_keys": \["(actor|critic)"\], (?="layer_norm")'
    r'|"motions": \{\}, '
    r'|"recorders": \{\}, |"policy_starts": 0, |"offline": null, '
    r'|"random_shift": 0, '
    # Of an arm, which had its model's servos alone; a walker's were there.
    r'|(?<=\.Arm"), "actuators": \[\]'
    r'|"free_root": false, |"root_turn": \[1.0, 0.0, 0.0, 0.0\], '
)


def run_cfg(row: Row, seed: int, *, device: str = "auto", smoke: bool = False) -> RunCfg:
    """Compose the config of a seed, as `ksim-rl train` does; a ValueError names the override that is wrong.

    Names stand for the folders of the rows that it learns from. A table is data: a field by which a run writes or
    listens outside of its folder is refused.
    """
    # The same words as on a command line, so that a row can be repeated by hand.
    words = [f"task={row.task}", f"objective={row.objective}", f"seed={seed}", f"device={device}"]
    words += [
        *FIXED.split(),
        *row.overrides,
        *overrides_of(row),
        f"trainer.eval_episodes={8 if smoke else row.episodes}",
    ]
    cfg = conf.compose([*words, *(SMOKE.split() if smoke else ())])
    # A table may be a stranger's file.
    for path, value in reaching_outside(cfg.to_tree()):
        raise ValueError(
            f"overrides: {path}={value!r} reaches outside of the run folder, which a table may not: leave it out, or "
            "train that row with ksim-rl train"
        )
    _check_course(row, cfg)
    per_iteration = cfg.num_envs * cfg.data.rollout_length(cfg.num_envs)
    if smoke:
        num_iterations = 2
    else:
        # As many whole iterations as fit into the row's env states.
        num_iterations = max(1, int(row.env_states // per_iteration))
    # Compiling would take longer than the two iterations.
    if smoke and hasattr(cfg.objective, "compile"):
        quick = {"compile": False}
    else:
        quick = {}
    # Compiled before the clock starts, since compiling is no part of learning.
    compiles = getattr(cfg.objective, "compile", False) and not smoke
    trainer = replace(cfg.trainer, num_iterations=num_iterations, video=False, warm_up=compiles)
    return replace(cfg, trainer=trainer, objective=replace(cfg.objective, **quick))


def _check_course(row: Row, cfg: RunCfg) -> None:
    """Refuse a course of a task that has none, or a level beyond its hardest."""
    if row.course_level is None:
        return
    with naming("course_level"):
        course = course_of(cfg.task)
    check_in_range("course_level", row.course_level, low=0, high=course.grid.num_levels - 1)


class RowCfgs:
    """The configs of a table's rows, each composed once, and their fingerprints."""

    def __init__(self, rows: Mapping[str, Row], *, smoke: bool = False) -> None:
        self.rows = rows
        self._smoke = smoke
        self._cfgs: dict[str, RunCfg] = {}
        self._settings: dict[str, str] = {}
        self._files: dict[str, FilesHere] = {}

    def cfg(self, name: str) -> RunCfg:
        """Return the config of a row with seed 1, which names the rows that it learns from."""
        if name not in self._cfgs:
            self._cfgs[name] = run_cfg(self.rows[name], 1, smoke=self._smoke)
        return self._cfgs[name]

    def settings(self, name: str) -> str:
        """Return the fingerprint of a row, which is another one where a row that it learns from has other settings."""
        if name not in self._settings:
            sources = [self.settings(source) for source in sources_of(self.rows[name])]
            self._settings[name] = settings(self.rows[name], self.cfg(name), sources=sources)
        return self._settings[name]

    def read_by(self, name: str) -> Iterator[ReadFile]:
        """Yield what a row reads, and then what the rows read that it learns from, with their names in front."""
        yield from files_read(self.cfg(name), self.rows[name])
        for source in sources_of(self.rows[name]):
            for file in self.read_by(source):
                yield replace(file, name=f"{source}: {file.name}")

    def fits(self, name: str, result: Result) -> bool:
        """Return whether a result is of the settings that a row has now, and of the files that are there now."""
        if result["settings"] != self.settings(name):
            return False
        # Hashed once: large models take a second.
        if name not in self._files:
            self._files[name] = FilesHere(self.read_by(name))
        return self._files[name].fit(result.get("files"))


def settings(row: Row, cfg: RunCfg, *, sources: Sequence[str] = ()) -> str:
    """Return a fingerprint of all that makes a row except its seed: seeds of different settings are never mixed.

    `sources` are the fingerprints of the rows that it learns from.
    """
    # The seed tells rows of one setting apart; the device is recorded in the result.
    tree = {key: value for key, value in cfg.to_tree().items() if key not in ("seed", "device")}
    tree["row"] = {"levels": dict(row.levels), "episodes": row.episodes, "measure": row.measure}
    for name in ("recorded", "learns_from", "begins_from", "taught_by"):
        # Rows of before have none of these.
        if value := getattr(row, name):
            tree["row"][name] = value
    if row.course_level is not None:
        # Policies of other courses are not compared.
        tree["row"]["course"] = [row.course_level, COURSE_ROBOTS, SPEED, GROUND_SEED, ROBOT_SEED]
    if sources:
        tree["row"]["sources"] = list(sources)
    # Later fields with values that change nothing must not make older results invalid.
    text = LATER.sub("", json.dumps(tree, sort_keys=True, default=str))
    # Neither must paths that classes have had since the first tables.
    for earlier, package in MOVED_CLASSES.items():
        now = f"{package}.{earlier.rpartition('.')[2]}"
        text = text.replace(f'"{now}"', f'"{earlier}"')
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class _Judge(Hook):
    """Keeps the figures of the end of training: the evaluation comes before this hook."""

    interval = 0

    def __init__(self, cfg: RunCfg, row: Row, *, trials: int) -> None:
        self._cfg = cfg
        if row.measure == "success":
            self._trials = trials
        else:
            self._trials = 0
        self.actor: TensorDictModuleBase | None = None
        self.found: Result = {"trials": None, "means": {}}
        self.seconds_in_all = 0.0
        self.ended = 0.0

    def at_end(self, trainer: Trainer) -> None:
        # Before the trials below, which take their own time.
        self.ended = time.monotonic()
        self.seconds_in_all = trainer.clock.total
        assert (evaluator := trainer.evaluator) is not None
        self.actor = trainer.update.actor
        # Terminations before the time limit are falls; on rough ground the edge of a patch truncates.
        fell_E = evaluator.terminated_E & (evaluator.length_E < evaluator.max_steps)
        self.found["falls"] = round(float(fell_E.double().mean()), 5)
        if episodes := part(evaluator.env, EpisodeSums):
            sums = episodes.episode_log()
        else:
            sums = {}
        metrics = {
            name: float(sums[name] / sums["episodes"])
            for name in sums
            if name.startswith("metric/")
        }
        self.found["means"] = {
            f"evaluation/{name}": round(mean, 4) for name, mean in metrics.items()
        }
        # Trials are run by the trained policy, in envs of their own.
        if self._trials:
            how = {"trials": self._trials, "note": trainer.progress.note}
            trials = run_trials(self._cfg, trainer.update.actor, **how)
            self.found["trials"] = asdict(trials)
            if trials.held_out is not None:
                self.found["means"][HELD_OUT] = trials.held_out


def _walk_course(cfg: RunCfg, row: Row, actor: TensorDictModuleBase, *, smoke: bool) -> Tree:
    """Let the final policy walk the course of its task; return the shares that succeed and fall as plain data."""
    level = row.course_level
    assert level is not None
    course = course_of(cfg.task)
    num_robots = COURSE_ROBOTS
    if smoke:
        num_robots = course.grid.num_levels * course.grid.num_columns
        # As short as its other episodes.
        course = replace(
            course, cfg=replace(course.cfg, episode_length_s=cfg.task.episode_length_s)
        )
    outcomes = walk(Policy(cfg=cfg, actor=actor, iteration=0), course, num_envs=num_robots)
    for line in outcomes.lost:
        show(f"warning: on the course: {line}")
    by_level, figures = summary(
        outcomes, kinds=course.grid.columns, num_levels=course.grid.num_levels
    )
    return {
        "level": level,
        "fell": round(figures["fell"], 4),
        "success": round(figures["success"], 4),
        "success_by_level": {
            kind: [round(share, 4) for share in shares] for kind, shares in by_level.items()
        },
        "fell_by_kind": {kind: round(figures[f"{kind}/fell"], 4) for kind in by_level},
        "lost": list(outcomes.lost),
        "lost_worlds": outcomes.lost_worlds,
    }


def _record(cfg: RunCfg, row: Row, judge: _Judge, run_folder: Path, *, smoke: bool) -> int:
    """Keep episodes of the final policy in the run folder; return how many env states they are."""
    folder = run_folder / EPISODES
    # Episodes of an earlier attempt are of another policy.
    if folder.is_dir():
        shutil.rmtree(folder)
    actor = judge.actor
    assert actor is not None
    wanted = SMOKE_EPISODES if smoke else row.recorded
    contents, interrupt = collect_episodes(
        cfg,
        lambda env: actor,
        folder,
        CollectCfg(
            num_episodes=wanted,
            num_envs=min(wanted, RECORDED_ENVS),
            seed=cfg.seed + RECORDED_SEED_OFFSET,
            as_in_training=True,
        ),
        title=f"{cfg.task_name}, final policy of seed {cfg.seed}",
        note=show,
    )
    if interrupt.signal is not None:
        raise KeyboardInterrupt
    return contents.num_env_states


def measure(
    row: Row,
    seed: int,
    run_folder: Path,
    *,
    device: str,
    smoke: bool,
    sources: Sources | None = None,
) -> Result:
    """Train and judge; return plain data. An interrupted run raises, so that it leaves no result.

    A row that learns from others needs the `sources`; a ValueError says what is wrong with their runs.
    """
    # Composed once: the fingerprint is of the very config that is trained, but for the folders of this machine.
    named = run_cfg(row, seed, device=device, smoke=smoke)
    cfg = named
    learned_from: list[str] = []
    files_of_sources: dict[str, str] = {}
    if sources_of(row):
        assert sources is not None
        finished = sources.of(row, seed)
        cfg = with_sources(named, row, sources.folders(row, seed))
        learned_from = [finished[name]["settings"] for name in sources_of(row)]
        for name, source in finished.items():
            files_of_sources |= {
                f"{name}: {file}": sha256 for file, sha256 in source["files"].items()
            }
    files = hashes_of(files_read(named, row))
    clear_finished(run_folder)
    judge = _Judge(cfg, row, trials=8 if smoke else row.episodes)
    progress = RunProgress(cfg.trainer.num_iterations)
    began = time.monotonic()
    with compile_notice(progress.status):
        outcome = run(cfg, run_folder, progress=progress, hooks=[judge])
    # Half a run says nothing.
    if outcome.interrupted_by is not None or outcome.evaluation is None:
        raise KeyboardInterrupt
    # Clips and models are read in training, in trials and on the course.
    if changed := [
        name for name, sha256 in hashes_of(files_read(named, row)).items() if files[name] != sha256
    ]:
        raise ValueError(f"{changed[0]} has changed while the row was trained: run it again")
    if row.course_level is not None:
        assert judge.actor is not None
        course = _walk_course(cfg, row, judge.actor, smoke=smoke)
        judge.found["course"] = course
        shares = [by_level[row.course_level] for by_level in course["success_by_level"].values()]
        judge.found["means"][COURSE_LEAST] = min(shares)
    if row.recorded:
        judge.found["recorded_env_states"] = _record(cfg, row, judge, run_folder, smoke=smoke)
    names = ("env_states", "seconds", "episode/return", "episode/length", *row.levels)
    _, lines = read_table(run_folder / METRICS)
    points = []
    for line in lines:
        if line.get("seconds"):
            points.append({name: float(line[name]) for name in names if line.get(name)})
    if row.levels:
        # The first point from which on the levels hold.
        end = reached(points, row.levels)
    else:
        end = None
    # The last env states of training, in which levels should hold.
    last = [
        point for point in points if point["env_states"] >= points[-1]["env_states"] - HELD_STATES
    ]
    session = record.read(run_folder)[-1]
    # Where the package is installed without git, the environment may name the commit.
    code = session.code.get("ksim_rl", {"commit": os.environ.get("GIT_COMMIT", "unknown")})
    result = {
        # Without the folders of this machine.
        "settings": settings(row, named, sources=learned_from),
        "files": files | files_of_sources,
        "commit": code["commit"] + ("-dirty" if len(code) > 1 else ""),
        "date": session.began,
        "versions": dict(session.versions),
        "device": next((v for k, v in session.hardware.items() if k.startswith("gpu")), "CPU"),
        "env_states": outcome.env_states,
        # From the start of training, its first iteration included; what was compiled and allocated before is apart.
        "seconds": round(points[-1]["seconds"], 2),
        "seconds_before": round(judge.ended - began - judge.seconds_in_all, 2),
        "evaluation": asdict(outcome.evaluation),
        **judge.found,
        "means": means_of(last, row.levels) | judge.found["means"],
        "seconds_to_levels": None if end is None else round(end["seconds"], 2),
        "env_states_to_levels": None if end is None else end["env_states"],
        "curve": thinned(points, KEPT_POINTS),
    }
    # Last: other rows learn from a run that has all that its row keeps.
    write_finished(run_folder, result, seed)
    return result


def main(
    name: str, row: str, seed: str, result: str, run_folder: str, device: str, smoke: str = ""
) -> None:
    """Measure and write; the result appears whole or not at all."""
    go_to_parents_folder()  # the table, and the paths of the command, are as they were given there
    plugins.load([])  # from KSIM_RL_PLUGINS, where `ksim-rl --plugin` has put its own
    # The child composes the row itself: it gets names only.
    rows = load(name).rows
    cfgs = RowCfgs(rows, smoke=bool(smoke))
    found = measure(
        rows[row],
        int(seed),
        Path(run_folder),
        device=device,
        smoke=bool(smoke),
        sources=Sources(
            runs=runs_of(Path(run_folder), row),
            fits=cfgs.fits,
            results=runs_of(Path(result), row),
        ),
    )
    path = Path(result)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
