"""One process at a time writes a run folder: a second is refused, a dead one's lock is taken over, readers go on."""

import errno
import fcntl
import json
import os
import signal
import subprocess
import sys
import time

import pytest

from ksim_rl.cli import main, run_commands, train
from ksim_rl.runs import run_lock
from ksim_rl.runs.run_lock import LOCK, is_locked, locked
from ksim_rl.trainers import run_folder


@pytest.fixture
def notes():
    return []


def hold(folder):
    """Let another process hold the lock of a folder; return it."""
    lines = (
        "import pathlib, runpy, time",
        f"locked = runpy.run_path({run_lock.__file__!r})['locked']",
        f"with locked(pathlib.Path({str(folder)!r}), note=print):",
        "    print('held', flush=True)",
        "    time.sleep(60)",
    )
    process = subprocess.Popen(
        [sys.executable, "-c", "\n".join(lines)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    return process


@pytest.fixture
def held(tmp_path):
    process = hold(tmp_path)
    yield process
    process.kill()
    process.wait()


def test_the_lock_is_there_while_it_is_held_and_gone_afterwards(tmp_path, notes):
    with locked(tmp_path, note=notes.append):
        assert (
            is_locked(tmp_path) and json.loads((tmp_path / LOCK).read_text())["pid"] == os.getpid()
        )
    assert not is_locked(tmp_path) and list(tmp_path.iterdir()) == [] and notes == []


def test_it_is_given_back_when_a_run_fails(tmp_path, notes):
    with pytest.raises(ZeroDivisionError), locked(tmp_path, note=notes.append):
        1 / 0  # noqa: B018
    assert list(tmp_path.iterdir()) == []


def test_a_second_process_is_refused_in_one_line_with_pid_host_and_time(tmp_path, held, notes):
    known = json.loads((tmp_path / LOCK).read_text())
    assert known["pid"] == held.pid
    with pytest.raises(ValueError) as raised, locked(tmp_path, note=notes.append):
        pytest.fail("both write")
    text = str(raised.value)
    assert (
        f"process {held.pid} on {os.uname().nodename!r}, begun {known['since']!r}, writes this run"
        in text
    )
    assert "\n" not in text and str(tmp_path) in text
    assert is_locked(tmp_path), "the refused one leaves the lock alone"


@pytest.mark.parametrize("command", ["resume", "train"])
def test_commands_that_write_exit_with_2(tmp_path, held, command, capsys, monkeypatch):
    monkeypatch.setattr(run_folder, "_run_locked", lambda *_: pytest.fail("both write"))
    monkeypatch.setattr(run_commands.checkpoint, "load_latest", saved)
    (tmp_path / "config.yaml").write_text("")
    own = (
        ["resume", str(tmp_path)]
        if command == "resume"
        else ["train", "num_envs=64", f"hydra.run.dir={tmp_path}"]
    )
    with pytest.raises(SystemExit) as stopped:
        main.main(own)
    error = capsys.readouterr().err
    assert stopped.value.code == 2
    assert f"process {held.pid} on" in error and error.count("\n") == 1
    beside = [path for path in tmp_path.parent.iterdir() if path.name.startswith(tmp_path.name)]
    assert beside == [tmp_path], "no other folder is made"


def saved(run, note):
    from ksim_rl import conf
    from ksim_rl.trainers import Checkpoint

    newest = run / "checkpoint" / "00000001"
    return Checkpoint(
        path=newest, iteration=1, config=conf.compose(["num_envs=64"]).to_tree(), state={}
    )


def test_a_folder_that_was_not_named_is_one_beside(tmp_path, held):
    assert train._unused(tmp_path).name == f"{tmp_path.name}_2"
    held.kill()
    held.wait()
    assert train._unused(tmp_path) == tmp_path


def test_the_lock_of_a_process_that_was_killed_is_taken_over_and_said(tmp_path, held, notes):
    held.send_signal(signal.SIGKILL)
    held.wait()
    assert (tmp_path / LOCK).exists() and not is_locked(tmp_path)
    with locked(tmp_path, note=notes.append):
        assert json.loads((tmp_path / LOCK).read_text())["pid"] == os.getpid()
    assert (
        len(notes) == 1
        and f"left by process {held.pid} on" in notes[0]
        and "takes it over" in notes[0]
    )


@pytest.mark.parametrize("text", ["x" * 5000, '{"pid": "\\u001b[2J"}', "[1]", '{"pid": 1}'])
def test_a_lock_with_anything_in_it_is_taken_over(tmp_path, notes, text):
    (tmp_path / LOCK).write_text(text)
    with locked(tmp_path, note=notes.append):
        pass
    assert len(notes) == 1 and "left by another process" in notes[0]


def test_it_is_not_taken_by_a_process_that_waited_for_a_file_that_is_gone(
    tmp_path, notes, monkeypatch
):
    opened, flock = [], fcntl.flock

    def removed_meanwhile(file, how):
        flock(file, how)
        if not opened:
            (tmp_path / LOCK).unlink()
        opened.append(file)

    monkeypatch.setattr(fcntl, "flock", removed_meanwhile)
    with locked(tmp_path, note=notes.append):
        assert len(opened) == 2 and is_locked(tmp_path)


def test_a_glance_of_another_process_refuses_nobody(tmp_path, notes):
    with open(tmp_path / LOCK, "w") as glance:
        fcntl.flock(glance, fcntl.LOCK_EX)
        began = time.monotonic()
        with pytest.raises(ValueError, match="another process writes this run"):
            run_lock._take(tmp_path)
        assert time.monotonic() - began > 0.5, "it waits for the name of a holder"
    with locked(tmp_path, note=notes.append):
        assert notes == []


def test_where_there_are_no_locks_a_run_says_so_and_goes_on(tmp_path, notes, monkeypatch):
    def refuse(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with locked(tmp_path, note=notes.append):
        assert len(notes) == 1 and "cannot be locked" in notes[0]


@pytest.mark.parametrize("kind", ["link", "hard link", "pipe"])
def test_what_leads_elsewhere_is_no_lock(tmp_path, notes, kind):
    run, precious = tmp_path / "run", tmp_path / "precious"
    run.mkdir()
    precious.write_text("precious")
    if kind == "pipe":
        os.mkfifo(run / LOCK)
    elif kind == "link":
        (run / LOCK).symlink_to(precious)
    else:
        (run / LOCK).hardlink_to(precious)
    assert not is_locked(run)
    refused = pytest.raises(
        ValueError, match=r"run/\.lock: .*only files of this folder alone are written"
    )
    with refused, locked(run, note=notes.append):
        pass
    assert precious.read_text() == "precious"
