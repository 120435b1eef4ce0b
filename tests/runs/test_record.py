"""The record of a run: what it came about by, and how it stands, also after its process was killed."""

import json
import subprocess
import sys

import pytest

from ksim_rl.config import plugins
from ksim_rl.files.writing import WRITING
from ksim_rl.runs import record
from tests.runs.test_run_lock import hold

SECRET = "a-token-that-nobody-may-see"


@pytest.fixture
def notes():
    return []


def git(folder, *arguments):
    who = ["-c", "user.name=a", "-c", "user.email=a@b"]
    subprocess.run(["git", *who, "-C", str(folder), *arguments], check=True, capture_output=True)


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A plug-in in a repository of its own."""
    folder = tmp_path / "code"
    (folder / "some_robots").mkdir(parents=True)
    (folder / "some_robots" / "__init__.py").write_text("MASS = 1.0\n")
    git(folder, "init")
    git(folder, "add", ".")
    git(folder, "commit", "-m", "first")
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setenv(plugins.VARIABLE, "")
    monkeypatch.setattr(plugins, "_named", [])
    plugins.load(["some_robots"])
    yield folder
    sys.modules.pop("some_robots")


@pytest.fixture
def run(tmp_path):
    (tmp_path / "run").mkdir()
    return tmp_path / "run"


def test_a_run_that_ends_says_how_and_what_it_was_made_of(run, notes):
    with record.recorded(
        run, command=["ksim-rl", "train", "num_envs=4"], note=notes.append
    ) as ended:
        (during,) = record.read(run)
        ended("done", "solved")
    (session,) = record.read(run)
    assert (during.status, session.status, session.why) == ("running", "done", "solved")
    assert (
        session.command == "ksim-rl train num_envs=4"
        and session.ended >= session.began == during.began
    )
    assert session.versions["python"] == sys.version.split()[0] and "mujoco" in session.versions
    assert int(session.hardware["cores"]) > 0
    assert record.status(run) == ("done", "solved") and notes == []


def test_a_resumed_run_has_an_entry_for_each_session(run, notes):
    for why in ("SIGINT", "all"):
        with record.recorded(run, note=notes.append) as ended:
            ended("interrupted" if why == "SIGINT" else "done", why)
    assert [(s.status, s.why) for s in record.read(run)] == [
        ("interrupted", "SIGINT"),
        ("done", "all"),
    ]


@pytest.mark.parametrize(
    ("error", "status"), [(ValueError("a fault"), "failed"), (KeyboardInterrupt(), "interrupted")]
)
def test_what_ends_a_run_is_kept(run, notes, error, status):
    with pytest.raises(type(error)), record.recorded(run, note=notes.append):
        raise error
    assert record.status(run)[0] == status and str(error) in record.status(run)[1]


def test_a_killed_run_has_failed_and_a_living_one_runs(run, notes):
    process = hold(run)
    text = json.dumps(
        {"sessions": [{"began": "2030-01-01 00:00:00", "command": "x", "status": "running"}]}
    )
    (run / record.RECORD).write_text(text)
    assert record.status(run)[0] == "running"
    process.kill()
    process.wait()
    status, why = record.status(run)
    assert status == "failed" and "killed" in why


def test_commit_and_changes_of_a_plug_in_are_kept(run, package, notes):
    with record.recorded(run, note=notes.append):
        pass
    clean = record.read(run)[0].code["some_robots"]
    assert len(clean["commit"]) == 40 and set(clean) == {"commit"}
    (package / "some_robots" / "__init__.py").write_text("MASS = 2.0\n")
    (package / "some_robots" / "new.py").write_text("")
    with record.recorded(run, note=notes.append):
        pass
    changed = record.read(run)[1].code["some_robots"]
    assert changed == clean | {"changed": "some_robots.2.diff", "not in git": "some_robots/new.py"}
    assert "-MASS = 1.0\n+MASS = 2.0\n" in (run / "some_robots.2.diff").read_text()


def test_a_repository_that_only_lies_around_is_not_asked(
    run, tmp_path, package, monkeypatch, notes
):
    """Where another user's folder is the working directory, its settings would have git run programs."""
    mark = tmp_path / "executed"
    around = tmp_path / "around"
    around.mkdir()
    git(around, "init")
    git(around, "config", "core.fsmonitor", f"touch {mark}; false")
    monkeypatch.chdir(around)
    with record.recorded(run, note=notes.append):
        pass
    assert not mark.exists() and "around" not in (run / record.RECORD).read_text()
    git(package, "config", "core.fsmonitor", f"touch {mark}; false")
    git(package, "config", "diff.external", f"touch {mark}; false")
    (package / "some_robots" / "__init__.py").write_text("MASS = 3.0\n")
    with record.recorded(run, note=notes.append):
        pass
    assert not mark.exists() and "changed" in record.read(run)[1].code["some_robots"]


def test_nothing_of_the_environment_enters_the_folder(run, monkeypatch, notes):
    monkeypatch.setenv("WANDB_API_KEY", SECRET)
    with record.recorded(run, note=notes.append):
        pass
    assert all(SECRET not in path.read_text(errors="replace") for path in run.iterdir())


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        "[]",
        '{"sessions": [{"began": 1, "command": "x"}]}',
        '{"sessions": [{"began": "", "command": "", "status": "owned"}]}',
        '{"sessions": [{"began": "", "command": "", "code": {"a": "b"}}]}',
        '{"sessions": [{"began": "", "command": "", "other": ""}]}',
    ],
)
def test_a_record_of_other_things_is_said_and_replaced(run, notes, text):
    (run / record.RECORD).write_text(text)
    with pytest.raises(ValueError, match=r"run\.json: no record of a run"):
        record.read(run)
    assert record.status(run)[0] == "unknown"
    with record.recorded(run, note=notes.append):
        pass
    assert len(record.read(run)) == 1 and "it starts over" in notes[0]


def test_what_a_stranger_wrote_does_not_command_the_terminal(run):
    session = {"began": "\x1b[2J", "command": "a\nb", "status": "done", "why": "\x1b]0;owned\x07"}
    (run / record.RECORD).write_text(json.dumps({"sessions": [session]}))
    (read,) = record.read(run)
    assert (read.began, read.command, read.why) == (" [2J", "a b", " ]0;owned ")


def test_links_and_pipes_of_a_stranger_are_not_followed(run, tmp_path, notes):
    outside = tmp_path / "outside"
    outside.write_text("mine")
    (run / record.RECORD).symlink_to(outside)
    (run / f"{WRITING}{record.RECORD}").symlink_to(outside)
    assert record.status(run)[0] == "unknown"
    with (
        pytest.raises(ValueError, match=r"run\.json: a link"),
        record.recorded(run, note=notes.append),
    ):
        pass
    assert outside.read_text() == "mine"
