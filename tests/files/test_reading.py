"""Every file that a stranger may have written is opened by one function: a regular one of limited size."""

import ast
import tracemalloc
from pathlib import Path

import pytest

from ksim_rl.files import reading
from ksim_rl.files.reading import read_bytes


def test_memory_is_taken_for_the_file_and_not_for_the_limit(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"x" * 1000)
    tracemalloc.start()
    try:
        content = read_bytes(path, limit=2**30)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert content == b"x" * 1000
    assert peak < 100_000


def test_a_file_beyond_the_limit_and_what_is_no_file_are_refused_by_name(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"x" * 1000)
    with pytest.raises(ValueError, match="file: damaged: longer than the 999 bytes"):
        read_bytes(path, limit=999)
    with pytest.raises(ValueError, match="cannot be read"):
        read_bytes(tmp_path, limit=999)
    with pytest.raises(ValueError, match="none: missing"):
        read_bytes(tmp_path / "none", limit=999)


PACKAGE = Path(reading.__file__).parents[1]
LOADS = {"np.load", "torch.load", "json.load", "onnx.load", "safe_open", "open", "np.memmap"}
METHODS = {"read_text", "from_file", "from_xml_path"}
# What they read is the system's, an installed package's, their own child's, in a folder of their own, or was checked
# before; `files.py` stands alone beside an export, and has a function of its own.
OTHERS = {
    "compiled/packages.py": {"distribution.read_text"},
    "data/episode_reader.py": {"np.memmap"},
    "diagnosis/doctor.py": {"NVIDIA.read_text"},
    "export/folder.py": {"(STANDALONE / f'{name}.py').read_text"},
    "export/onnx_file.py": {"onnx.load"},
    "export/sim2sim.py": {"output.read_text"},
    "export/standalone/deadlines.py": {"Path('/proc/self/statm').read_text"},
    "export/standalone/files.py": {"np.load"},
    "export/standalone/models.py": {"mujoco.MjModel.from_xml_path"},
    "physics/load.py": {"mujoco.MjSpec.from_file"},
    "physics/nan_guard/failures.py": {"open", "safe_open"},
    "runs/csv_table.py": {"open"},
    "runs/record.py": {"processors.read_text"},
    "trainers/checkpoint.py": {"open"},
    "trainers/trial.py": {"json.load"},
    "viewer/live_training.py": {"(folder / CONFIG).read_text", "torch.load"},
    "viewer/pad.py": {"PAGE.read_text"},
}


def readers(tree):
    """Return what a module calls that reads files in another way than by `files/reading.py`."""
    found = set()
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        called = ast.unparse(node.func)
        name = called.rpartition(".")[2]
        is_method = name in METHODS or (name == "read_bytes" and called != name)
        # Files that come with the package are its own.
        if called in LOADS or (is_method and not called.startswith(("files(", "(files("))):
            found.add(called)
    return found


def test_one_module_opens_files():
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        found[name] = readers(ast.parse(path.read_text())) - OTHERS.get(name, set())
    assert {name: seen for name, seen in found.items() if seen} == {}


def test_the_search_finds_others():
    text = "path.read_text()\nnp.load(path)\nopen(path)\npath.read_bytes()\nnp.memmap(path)"
    assert readers(ast.parse(text)) == {
        "path.read_text",
        "np.load",
        "open",
        "path.read_bytes",
        "np.memmap",
    }
