"""Files appear whole, and what leads elsewhere is refused: links, hard links, pipes."""

import ast
import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from ksim_rl.files import writing
from ksim_rl.files.writing import (
    make_folder,
    open_own,
    unfinished_folder,
    whole_file,
    whole_folder,
    write_whole,
)

PACKAGE = Path(writing.__file__).parents[1]
WRITES = {
    "write_text",
    "write_bytes",
    "savez",
    "savez_compressed",
    "copyfile",
    "copytree",
    "copy",
    "copy2",
    "move",
}
# Where what is given to the function lies in an unfinished folder, or in a new one of this process.
OTHERS = {
    "cli/new.py": {"copy", "copyfile"},
    "export/folder.py": {"write_text", "savez_compressed"},
    "export/policy.py": {"write_bytes"},
    "export/robot.py": {"write_text", "write_bytes"},
    "export/sim2sim.py": {"write_text"},
    "export/standalone/command.py": {"write_text", "savez_compressed"},
    "export/standalone/journal.py": {"open"},  # a new file of a program that stands alone
    "export/standalone/loop_command.py": {"write_text"},
    "zoo/adding.py": {"write_text", "copyfile"},
    "zoo/sources.py": {"copytree"},
    "clips/motion_file.py": {"savez_compressed"},  # into memory
    "files/writing.py": {"write_bytes", "os.open"},
    "files/reading.py": {"os.open"},
    "trainers/checkpoint.py": {"open", "os.open"},  # into an unfinished folder, and to flush one
    "runs/csv_table.py": {"open"},  # of a path that was checked when the table was opened
    "physics/nan_guard/failures.py": {"open"},  # of the path that `whole_file` gives
    "export/standalone/files.py": {"os.open"},  # it stands alone, and reads
}


def writers(tree):
    """Return what a module calls that writes files in another way than by `files/writing.py`."""
    found = set()
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        called = ast.unparse(node.func)
        name = called.rpartition(".")[2]
        modes = [
            word.value
            for word in node.args
            if isinstance(word, ast.Constant) and isinstance(word.value, str)
        ]
        if name in WRITES and (name not in ("copy", "move") or called.startswith("shutil.")):
            found.add(name)
        elif called == "os.open":
            found.add(called)
        elif name == "open" and any(set(mode) & set("wax+") and len(mode) < 4 for mode in modes):
            found.add("open")
    return found


def test_one_module_writes_files():
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        found[name] = writers(ast.parse(path.read_text())) - OTHERS.get(name, set())
    assert {name: seen for name, seen in found.items() if seen} == {}


@pytest.mark.parametrize(
    "text", ["p.write_text('')", "open(p, 'w')", "p.open('ab')", "import os\nos.open(p, 1)"]
)
def test_the_search_finds_others(text):
    assert writers(ast.parse(text))


def link(path, target):
    path.symlink_to(target)


def hard_link(path, target):
    path.hardlink_to(target)


def pipe(path, target):
    os.mkfifo(path)


@pytest.fixture(params=[link, hard_link, pipe])
def trap(request, tmp_path):
    """Return what makes a path that leads to the user's file, or to nowhere."""
    target = tmp_path / "precious"
    target.write_text("precious")
    yield lambda path: request.param(path, target)
    assert target.read_text() == "precious"


REFUSED = r"a link, and only|2 names \(hard links\), and only|no regular file, and only"


def test_no_file_is_written_where_something_leads_elsewhere(trap, tmp_path):
    trap(tmp_path / "trap")
    before = sorted(os.listdir(tmp_path))
    for write in (lambda path: write_whole(path, "x"), lambda path: open_own(path).write("x")):
        with pytest.raises(ValueError, match=REFUSED):
            write(tmp_path / "trap")
    assert sorted(os.listdir(tmp_path)) == before


def test_a_name_that_is_no_utf8_is_refused(tmp_path):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff"))
    folder.mkdir()
    for write in (
        lambda: write_whole(folder / "a", "x"),
        lambda: open_own(folder / "a"),
        lambda: fill(folder),
    ):
        with pytest.raises(
            ValueError, match="bytes that are no UTF-8, with which nothing is written"
        ):
            write()
    assert list(folder.iterdir()) == []


def test_a_folder_is_filled_wholly_or_not_at_all(trap, tmp_path):
    folder = tmp_path / "folder"
    (folder / "assets").mkdir(parents=True)
    (folder / "a").write_text("old")
    trap(folder / "assets" / "trap")
    with (
        pytest.raises(ValueError, match=REFUSED),
        whole_folder(folder, below=tmp_path) as unfinished,
    ):
        (unfinished / "a").write_text("new")
        (unfinished / "assets").mkdir()
        (unfinished / "assets" / "trap").write_text("x")
    assert (folder / "a").read_text() == "old" and sorted(os.listdir(folder)) == ["a", "assets"]


def test_a_folder_that_is_filled_keeps_its_other_files(tmp_path):
    folder = tmp_path / "folder"
    for number in ("1", "2"):
        with whole_folder(folder, below=tmp_path) as unfinished:
            assert list(unfinished.iterdir()) == []
            (unfinished / "below").mkdir()
            (unfinished / "below" / number).write_text(number)
            assert number == "2" or not (folder / "below").exists()
    assert sorted(os.listdir(folder / "below")) == ["1", "2"] and os.listdir(folder) == ["below"]


def test_nothing_is_left_where_filling_fails(tmp_path):
    with (
        pytest.raises(ZeroDivisionError),
        whole_folder(tmp_path / "folder", below=tmp_path) as unfinished,
    ):
        (unfinished / "a").write_text("new")
        1 / 0  # noqa: B018
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("path", ["export", "export/assets"])
def test_folders_are_not_reached_by_links(path, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    run = tmp_path / "run"
    (run / path).parent.mkdir(parents=True)
    (run / path).symlink_to(elsewhere)
    for make in (lambda: make_folder(run / "export" / "assets", below=run), lambda: fill(run)):
        with pytest.raises(
            ValueError, match=rf"run/{path}: a link, and nothing is written through links"
        ):
            make()
    assert list(elsewhere.iterdir()) == []
    (tmp_path / "mine").symlink_to(elsewhere)
    make_folder(tmp_path / "mine" / "new", below=tmp_path / "mine")  # which the user named
    assert (elsewhere / "new").is_dir()


def fill(run):
    with whole_folder(run / "export", below=run) as unfinished:
        (unfinished / "assets").mkdir()
        (unfinished / "assets" / "a").write_text("x")


def test_what_a_killed_process_left_is_deleted_and_what_a_living_one_fills_stays(tmp_path):
    child = os.fork()
    if not child:
        with unfinished_folder(tmp_path):
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    (left,) = tmp_path.iterdir()
    with unfinished_folder(tmp_path) as first:
        assert not left.exists()
        with unfinished_folder(tmp_path) as second:
            assert sorted(tmp_path.iterdir()) == sorted([first, second])


def test_a_file_that_was_a_writers_own_is_replaced_and_never_seen_half(tmp_path):
    path = tmp_path / "a"
    write_whole(path, "old")
    with whole_file(path) as temporary:
        temporary.write_text("ne")
        assert path.read_text() == "old"
    assert path.read_text() == "ne" and os.listdir(tmp_path) == ["a"]


@pytest.mark.parametrize("write", [write_whole, lambda path, text: fill(path.parent)])
def test_a_full_disk_is_said_with_the_file_or_folder_that_was_written(write, tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*/(a|export)'"):
        write(tmp_path / "a", "x")
    assert list(tmp_path.iterdir()) == []


def savers(tree):
    """Return the calls of torch that write a file themselves, where a full disk aborts the process."""
    found = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call) or ast.unparse(node.func) not in (
            "torch.save",
            "torch.export.save",
        ):
            continue
        if ast.unparse(node.args[1]) != "memory":
            found.append(ast.unparse(node))
    return found


def test_torch_writes_into_memory_only():
    found = [call for path in PACKAGE.rglob("*.py") for call in savers(ast.parse(path.read_text()))]
    assert found == []
    assert savers(ast.parse("torch.save(state, path)"))


# Prints which files the first three descriptors are, and then the next one that is opened.
LOOK = """\
import os, sys
from ksim_rl.files import writing
writing.open_streams()
opened = open(sys.argv[1], "w")
opened.write(f"{opened.fileno()} {[os.readlink(f'/proc/self/fd/{n}') for n in (0, 1, 2)].count(os.devnull)} ")
opened.write(f"{None in (sys.stdin, sys.stdout, sys.stderr)}")
sys.stderr.flush()
"""


@pytest.mark.parametrize("closed", [(2,), (0, 1, 2)])
def test_no_file_takes_the_place_of_a_stream_that_is_closed(closed, tmp_path):
    def close():
        for number in closed:
            os.close(number)

    out = tmp_path / "out"
    ended = subprocess.run([sys.executable, "-c", LOOK, str(out)], preexec_fn=close, timeout=120)
    assert ended.returncode == 0
    number, on_nothing, is_none = out.read_text().split()
    assert int(number) > 2 and int(on_nothing) >= len(closed) and is_none == "False"


def test_streams_that_are_open_stay(capfd):
    writing.open_streams()
    os.write(1, b"seen")
    assert capfd.readouterr().out == "seen"
