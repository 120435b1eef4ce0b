"""A run folder that is gone, moved, or read-only, and threads of loggers that fail."""

import os
import shutil
import threading

import pytest

from ksim_rl.files.writing import whole_file
from ksim_rl.runs import watch


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text("")
    return tmp_path / "run"


def moved(folder):
    folder.rename(folder.with_name("elsewhere"))


def made_anew(folder):
    shutil.copytree(folder, folder.with_name("copy"))
    shutil.rmtree(folder)
    folder.with_name("copy").rename(folder)


@pytest.mark.parametrize(
    "harm", [shutil.rmtree, moved, made_anew, lambda folder: (folder / "config.yaml").unlink()]
)
def test_a_folder_that_is_gone_ends_the_run(folder, harm):
    check = watch.watch(folder, holds="config.yaml", note=pytest.fail)
    check()
    harm(folder)
    with pytest.raises(OSError, match="deleted or moved while this run wrote it"):
        check()


def test_a_folder_that_has_become_read_only_is_said_once(folder, monkeypatch):
    notes = []
    check = watch.watch(folder, holds="config.yaml", note=notes.append)
    monkeypatch.setattr(os, "access", lambda *_: False)
    check(), check()
    assert len(notes) == 1 and "read-only" in notes[0]


def test_a_thread_that_fails_is_one_line(capsys):
    notes = []
    with watch.threads_that_fail(notes.append):
        thread = threading.Thread(target=lambda: 1 / 0, name="writer")
        thread.start()
        thread.join()
    assert notes == ["warning: writer ended: ZeroDivisionError: division by zero"]
    assert capsys.readouterr().err == ""


def test_a_file_is_there_only_when_it_is_whole(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), whole_file(path) as temporary:
        temporary.write_text("ne")
        1 / 0  # noqa: B018
    assert path.read_text() == "old" and [entry.name for entry in tmp_path.iterdir()] == ["a.txt"]
    with whole_file(path) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new"


def test_two_that_write_one_file_at_once_both_leave_it_whole(tmp_path):
    path = tmp_path / "a.txt"
    with whole_file(path) as first:
        first.write_text("first")
        with whole_file(path) as second:
            second.write_text("second")
        assert path.read_text() == "second"
    assert path.read_text() == "first" and [entry.name for entry in tmp_path.iterdir()] == ["a.txt"]
