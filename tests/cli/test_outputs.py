"""A place in which nothing can be written is refused in one line, by the option that names it, before any work."""

import pytest

from tests.conf.test_command_line import run

FOLDERS = [
    "play task=cartpole_swingup --agent zero --live --record",
    "collect task=cartpole_swingup --agent zero --output",
    "reproduce velocity --minutes 0 --output",
    "reproduce velocity --minutes 0 --runs",
    "new task mine --output",
    "new robot unitree_a1/a1 --output",
    "train task=cartpole_swingup hydra.run.dir=",
    "train --multirun task=cartpole_swingup,reacher hydra.sweep.dir=",
    "export RUN --output",
    "card RUN --output",
    "motion generate",
]
FILES = [
    ("play task=cartpole_swingup --agent zero --output", "video.mp4"),
    ("identify --propose quadruped --output", "plan.csv"),
    ("identify log.csv --robot quadruped --output", "found.json"),
    ("compare RUN OTHER --output", "compare.png"),
    ("robot unitree_a1/a1 --picture", "stance.png"),
    ("motion csv source.csv", "walk.npz"),
    ("motion rollout RUN", "walk.npz"),
]


@pytest.fixture(autouse=True)
def work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "FILE").write_text("in the way")
    return tmp_path


def refused(work, capsys, command, place):
    words = command.split()
    # A field of Hydra's has its value in the same word.
    if words[-1].endswith("="):
        words[-1] += place
    else:
        words.append(place)
    code, output = run(capsys, *words)
    assert code == 2, output.err
    assert output.err.count("\n") == 1 and output.out == ""
    assert "Errno" not in output.err
    assert [path.name for path in work.iterdir()] == ["FILE"]
    return output.err


@pytest.mark.parametrize("command", FOLDERS)
def test_a_folder_is_not_written_over_or_below_a_file(work, capsys, command):
    option = command.split()[-1].rstrip("=")
    said = refused(work, capsys, command, "FILE")
    # A new package or folder must not be there at all.
    assert "FILE: a file lies there: name a new folder" in said
    said = refused(work, capsys, command, "FILE/below/more")
    assert "FILE/below/more: FILE is a file: name a place in a folder" in said
    assert command.startswith("motion") or option in said


@pytest.mark.parametrize(("command", "name"), FILES)
def test_a_file_is_not_written_below_a_file_or_over_a_folder(work, capsys, command, name):
    said = refused(work, capsys, command, f"FILE/{name}")
    assert f"FILE/{name}: FILE is a file: name a place in a folder" in said
    (work / "FILE").unlink()
    (work / "FILE" / name).mkdir(parents=True)
    assert f"FILE/{name}: a folder lies there: name a new file" in refused(
        work, capsys, command, f"FILE/{name}"
    )
