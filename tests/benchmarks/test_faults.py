"""Each row passes in its short form, and fails where what protects from its fault is taken away."""

import contextlib
import copy
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from benchmarks import report
from benchmarks.faults import __main__ as command
from benchmarks.faults import (
    children,
    damaged_caches,
    environments,
    hostile_folder,
    machine,
    page,
    spread,
)
from benchmarks.faults.row import Row
from benchmarks.faults.rows import ROWS
from ksim_rl import terminal
from ksim_rl.algorithms.gradient_steps import RolloutUpdate
from ksim_rl.cli import errors
from ksim_rl.config import plain_data
from ksim_rl.device import room
from ksim_rl.envs.managers.action_manager import ActionManager
from ksim_rl.envs.non_finite import NonFiniteTerms
from ksim_rl.export.folder import runner_source
from ksim_rl.physics import load
from ksim_rl.physics.warp_world import WarpWorld
from ksim_rl.runs import csv_table, run_lock
from ksim_rl.scene.rendering import rendering
from ksim_rl.trainers import checkpoint, progress, run_cfg, run_folder
from ksim_rl.trainers import trainer as trainer_module
from ksim_rl.trainers.interrupt import InterruptRequest
from tests.cli.payloads import with_pickles, without_the_check_of_config
from tests.cli.test_foreign_files import with_pickled_arrays

RESULTS = report.RESULTS / "faults.json"
# Rows that take seconds; the full tests run the others, and the command runs the long form of each.
QUICK = (
    "latest",
    "corruption",
    "kill9",
    "data_files",
    "control_codes",
    "headless",
    "nan_actions",
    "nan_worlds",
)


def short(name, folder):
    """Run a row's short form, with torch's threads as they were afterwards."""
    threads = torch.get_num_threads()
    try:
        return ROWS[name].run(folder, short=True)
    finally:
        torch.set_num_threads(threads)


def quick(names):
    return [name if name in QUICK else pytest.param(name, marks=pytest.mark.full) for name in names]


SABOTAGE = {}


def sabotage(name):
    def register(harm):
        SABOTAGE[name] = harm
        return harm

    return register


@sabotage("latest")
def newest_in_any_case(patch):
    def newest(run, note=None):
        return SimpleNamespace(path=checkpoint.saved(run / "checkpoint")[-1])

    patch.setattr(checkpoint, "load_latest", newest)


@sabotage("corruption")
def no_hashes(patch):
    patch.setattr(checkpoint, "_sha256", lambda content: "0")


@sabotage("kill9")
def written_in_place(patch):
    """Write a checkpoint under its own name from the beginning."""

    def save(folder, state, *, iteration, config, keep=3):
        tensors, values = checkpoint.state_tree.split(state)
        content = checkpoint.safetensors.torch.save(tensors)
        files = {checkpoint.TENSORS: {"bytes": len(content), "sha256": checkpoint._sha256(content)}}
        known = {"format_version": 2, "iteration": iteration, "files": files, "values": values}
        path = folder / f"{iteration:08d}"
        path.mkdir(parents=True)
        checkpoint._write_durably(path / checkpoint.TENSORS, content)
        checkpoint._write_durably(
            path / checkpoint.MANIFEST, checkpoint._seal({**known, "config": dict(config)})
        )
        return path

    patch.setattr(checkpoint, "save", save)


@sabotage("resume")
def without_random_state(patch):
    patch.setattr(torch, "set_rng_state", lambda state: None)
    patch.setattr(trainer_module.RolloutCollector, "load_state_dict", lambda self, state: None)


@sabotage("disk_full")
def errors_are_not_said(patch):
    patch.setattr(errors, "report", lambda error, about="": 3)


@sabotage("folder_gone")
def nobody_watches(patch):
    patch.setattr(run_folder, "watch", lambda *_, **__: lambda: None)


@sabotage("signals")
def signals_as_python_has_them(patch):
    patch.setattr(errors, "sigterm_interrupts", contextlib.nullcontext)
    patch.setattr(InterruptRequest, "__enter__", lambda self: self)


@sabotage("lock")
def no_lock(patch):
    patch.setattr(run_lock, "try_lock", lambda file: True)


@sabotage("killed_commands")
def locks_outlive_their_process(patch):
    @contextlib.contextmanager
    def locked(folder, note):
        if (folder / run_lock.LOCK).exists():
            raise ValueError(f"{folder}: another process writes this run")
        (folder / run_lock.LOCK).write_text("")
        yield
        (folder / run_lock.LOCK).unlink()

    patch.setattr(run_folder, "locked", locked)


@sabotage("clock")
def wall_clock(patch):
    patch.setattr(progress.time, "monotonic", lambda: progress.time.time())


@sabotage("nan_worlds")
def worlds_are_not_cleared(patch):
    patch.setattr(WarpWorld, "reset", lambda *_: None)


@sabotage("nan_actions")
def actions_are_taken_as_they_are(patch):
    def apply(self, action_EL):
        self._action_EL.copy_(action_EL)
        self._run_terms(self._action_EL)
        return torch.ones(len(action_EL), dtype=torch.bool)

    patch.setattr(ActionManager, "apply", apply)


@sabotage("nan_terms")
def terms_are_not_watched(patch):
    patch.setattr(NonFiniteTerms, "lines", lambda self: [])


@sabotage("non_finite_loss")
def no_stop(patch):
    patch.setattr(RolloutUpdate, "check", lambda *_: None)


@sabotage("overflow")
def resets_forget(patch):
    reset = WarpWorld.reset

    def forget(self, mask_E):
        reset(self, mask_E)
        self.overflow_report()

    patch.setattr(WarpWorld, "reset", forget)


@sabotage("same_seed")
def seeds_of_the_process(patch):
    patch.setattr(
        torch, "manual_seed", lambda seed: torch.default_generator.manual_seed(os.getpid())
    )


@sabotage("threads")
def as_many_as_there_are(patch):
    patch.setattr(
        sys.modules["ksim_rl.trainers.build"], "default_threads", lambda device: os.cpu_count() - 1
    )


@sabotage("payloads")
def configs_are_not_checked(patch):
    # The short form always has the first of the families that it stops.
    without_the_check_of_config(patch)


@sabotage("data_files")
def pickles_are_loaded(patch):
    with_pickles(patch)
    with_pickled_arrays(patch)


@sabotage("small_files")
def tables_as_they_are(patch):
    patch.setattr(csv_table, "MOST_CELLS", 10**12)
    patch.setattr(plain_data, "MOST_CONFIG_BYTES", 2**40)


@sabotage("control_codes")
def letters_as_they_are(patch):
    patch.setattr(terminal, "_letter", lambda letter: letter)


@sabotage("models")
def as_mujoco_takes_them(patch):
    patch.setattr(load, "check_meant", lambda *_, **__: None)
    patch.setattr(load, "check_finite", lambda *_, **__: None)


@sabotage("hostile_folder")
def commands_and_children_begin_where_the_user_stands(patch):
    patch.setattr(
        hostile_folder, "PROGRAM", [word for word in hostile_folder.PROGRAM if word != "-P"]
    )


@sabotage("viewer_markup")
def names_as_they_stand(patch):
    for module in ("panel", "plots"):
        patch.setattr(f"ksim_rl.viewer.{module}.as_html", lambda text: text)


@sabotage("viewer_ports")
def the_gate_stands_open(patch):
    patch.setattr("ksim_rl.viewer.gate.Gate.refusal", lambda gate, request: None)


@sabotage("sim2sim_folders")
def records_as_they_are(patch):
    call = "    check_record(path, record, runner.meta, runner.model)\n"
    source = runner_source()
    assert call in source
    module = sys.modules["ksim_rl.export.sim2sim"]  # the room has a function of this name
    patch.setattr(module, "runner_source", lambda: source.replace(call, ""))


@sabotage("strange_tables")
def names_and_overrides_as_they_are(patch):
    for check in ("check_name", "check_override"):
        patch.setattr(f"ksim_rl.tables.table.{check}", lambda *_: None)


@sabotage("crafted_manifests")
def states_as_they_come(patch):
    patch.setattr(sys.modules["ksim_rl.trainers.build"], "fitting", contextlib.nullcontext)
    patch.setattr(checkpoint, "fitting", contextlib.nullcontext)


@sabotage("huge_numbers")
def nobody_looks_at_sizes(patch):
    patch.setattr(room, "check_room", lambda *_, **__: None)


@sabotage("wrong_inputs")
def errors_end_without_a_word(patch):
    patch.setattr("ksim_rl.cli.main.report", lambda error: 3)


@sabotage("caches")
def errors_as_warp_raises_them(patch):
    program = (
        "import sys; from ksim_rl.device import streams; streams.ValueError = OSError; "
        "from ksim_rl.cli.main import main; sys.exit(main())"
    )
    patch.setattr(machine, "PROGRAM", ("-c", program))


@sabotage("environments")
def limits_are_not_looked_at(patch):
    program = "from ksim_rl.cli import main, process; main.check_process = lambda: None; main.main(sys.argv[1:])"
    patch.setattr(environments, "PROGRAM", ("-P", "-c", f"import sys; {program}"))


@sabotage("damaged_caches")
def errors_as_compilers_raise_them(patch):
    program = (
        "from ksim_rl.device import compiler_caches; compiler_caches.explained = lambda error: None; "
        "from benchmarks.faults import compile_once; sys.exit(compile_once.main())"
    )
    patch.setattr(damaged_caches, "ONCE", ("-c", f"import sys; {program}"))


@sabotage("full_disk_of_commands")
def errors_end_without_words(patch):
    patch.setattr("ksim_rl.cli.main.report", lambda error: 3)


@sabotage("two_tables")
def nobody_waits_for_the_others_job(patch):
    patch.setattr(run_lock, "is_locked", lambda folder: False)
    patch.setattr(run_lock, "try_lock", lambda file: True)


@sabotage("no_gpu")
def the_device_is_not_looked_at(patch):
    patch.setattr(run_cfg.RunCfg, "__post_init__", lambda self: None)
    patch.setattr(run_cfg.RunCfg, "resolved_device", lambda self: torch.device("cpu"))


@sabotage("headless")
def egl_in_any_case(patch):
    always = type("Always", (), {"__wrapped__": staticmethod(lambda: "egl")})
    patch.setattr(rendering, "choose_gl_platform", always)


@sabotage("soak")
def rows_are_kept(patch):
    kept, log = [], csv_table.CsvTable.log_metrics

    def log_and_keep(self, metrics, step):
        kept.append({name: f"{value:.9g}" for name, value in metrics.items()})
        log(self, metrics, step)

    patch.setattr(csv_table.CsvTable, "log_metrics", log_and_keep)


sabotage("seen_soak")(rows_are_kept)


@pytest.mark.parametrize("name", quick(name for name, row in ROWS.items() if row.device == "cpu"))
def test_a_row_passes_in_its_short_form(name, tmp_path):
    figures, broken = short(name, tmp_path)
    assert broken == [], figures


@pytest.mark.parametrize("name", quick(SABOTAGE))
def test_a_row_fails_where_its_protection_is_taken_away(name, tmp_path, monkeypatch):
    children.warm()
    SABOTAGE[name](monkeypatch)
    _, broken = short(name, tmp_path)
    assert broken


def test_each_row_of_this_machine_has_a_sabotage():
    assert set(SABOTAGE) == {name for name, row in ROWS.items() if row.device == "cpu"}
    assert len(SABOTAGE) >= 20


def test_a_limit_breaks_where_a_figure_is_missing_or_beyond():
    row = Row(
        fault="",
        must="",
        limits={"a": ("at most", 1), "b": ("at least", "n")},
        measure=dict,
        amounts={"n": 3},
    )
    assert row.broken({"a": 1, "b": 3}) == []
    assert row.broken({"a": 2, "b": 3}) == ["a = 2: expected at most 1"]
    assert row.broken({"a": float("nan"), "b": 3}) == ["a = nan: expected at most 1"]
    assert row.broken({"a": 0}) == ["b = absent: expected at least 3"]


def test_what_is_committed_passes_by_its_figures_and_the_page_shows_it():
    saved = json.loads(RESULTS.read_text())
    assert saved["passed"] == page.passed(saved)
    assert page.with_table(page.PAGE.read_text(), saved) == page.PAGE.read_text()
    gpu = {name for name, row in ROWS.items() if row.device == "cuda"}
    assert set(saved["not_measured"]) == gpu - set(saved["passed"])


def test_a_figure_that_is_changed_fails_its_row():
    saved = copy.deepcopy(json.loads(RESULTS.read_text()))
    saved["figures"]["cpu/corruption/refused"] -= 1
    assert page.passed(saved)["corruption"] is False


def test_rows_side_by_side_are_merged_and_the_page_waits_for_those_that_are_committed(
    tmp_path, monkeypatch
):
    committed, elsewhere = tmp_path / "results", tmp_path / "elsewhere"
    made = json.loads(RESULTS.read_text())
    label = "cpu/latest/"
    of_latest = {name: value for name, value in made["figures"].items() if name.startswith(label)}

    run = subprocess.run

    def in_a_process(words, *, env=None, **options):
        if env is None:
            return run(words, **options)  # git
        name, form = words[3:]
        page.write_row(
            name,
            {key.removeprefix(label): value for key, value in of_latest.items()},
            passed=name == "latest",
            folder=Path(env["BENCHMARK_RESULTS"]),
        )
        assert env["CUDA_VISIBLE_DEVICES"] == "" and form == "form=long"
        return subprocess.CompletedProcess(
            words, returncode=int(name != "latest"), stdout=f"{name}\n"
        )

    monkeypatch.setattr(command.subprocess, "run", in_a_process)
    monkeypatch.setattr(page.report, "RESULTS", elsewhere)
    monkeypatch.setattr(page, "PAGE", tmp_path / "page.md")
    page.PAGE.write_text(f"{page.BEGIN}\n{page.END}")
    monkeypatch.setattr(sys, "argv", ["faults", "latest", "kill9", "jobs=2"])
    assert command.main() == 1
    saved = json.loads((elsewhere / "faults.json").read_text())
    assert saved["passed"] == {"latest": True, "kill9": False}
    assert saved["figures"].items() >= of_latest.items()
    assert "| `latest` |" not in page.PAGE.read_text()

    monkeypatch.setattr(page, "COMMITTED", committed)
    monkeypatch.setattr(page.report, "RESULTS", committed)
    monkeypatch.setattr(sys, "argv", ["faults", f"merge={elsewhere}"])
    assert command.main() == 0
    assert json.loads((committed / "faults.json").read_text())["passed"] == saved["passed"]
    assert "| `latest` |" in page.PAGE.read_text()


def test_cases_spread_over_processes_are_summed(tmp_path, monkeypatch):
    monkeypatch.setattr(children, "warm", lambda: None)
    cases = [lambda case=case: {"cases": 1, "sum": case, f"of_{case % 2}": 1} for case in range(5)]
    alone = spread.summed(cases, tmp_path, jobs=1)
    assert alone == {"cases": 5, "sum": 10, "of_0": 3, "of_1": 2}
    assert spread.summed(cases, tmp_path, jobs=2) == alone
    with pytest.raises(RuntimeError, match="no such figure"):
        spread.summed([*cases[:1], lambda: {}["no such figure"]], tmp_path, jobs=2)
