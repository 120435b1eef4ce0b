"""Errors of compilers name the cache and the fix; other errors are left as they are."""

import os
import subprocess
import sys
import types
from pathlib import Path

import pytest

from ksim_rl.cli.errors import FAILED
from ksim_rl.device.compiler_caches import explained, torch_cache, triton_cache

ROOT = Path(__file__).parents[2]


def test_folders_are_those_that_the_compilers_take(monkeypatch, tmp_path):
    from torch._inductor.runtime.cache_dir_utils import cache_dir

    monkeypatch.delenv("TORCHINDUCTOR_CACHE_DIR", raising=False)
    own = torch_cache().folder
    assert own == Path(cache_dir())
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    assert torch_cache().folder == tmp_path
    triton = pytest.importorskip("triton")
    monkeypatch.delenv("TRITON_CACHE_DIR", raising=False)
    assert triton_cache().folder == Path(triton.knobs.cache.dir)
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    assert triton_cache().folder == Path(triton.knobs.cache.dir) == tmp_path


COMPILE = """
import sys
from benchmarks.faults.compile_once import by_triton
from ksim_rl.cli.errors import report
try:
    sys.exit(by_triton())
except Exception as error:
    sys.exit(report(error))
"""


def _compiled_by_triton(cache: Path) -> subprocess.CompletedProcess[str]:
    """Compile a kernel in a process of its own: where kernels were interpreted, Triton's language stays changed."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    environment |= {"TRITON_CACHE_DIR": str(cache), "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [sys.executable, "-c", COMPILE], env=environment, capture_output=True, text=True
    )


@pytest.mark.parametrize(
    ("pattern", "damage"),
    [("__grp__*.json", "[]"), ("twice.json", "{")],
)
@pytest.mark.full
def test_a_damaged_cache_of_triton_is_named_in_one_line(pattern, damage, tmp_path):
    pytest.importorskip("triton")
    assert _compiled_by_triton(tmp_path).returncode == 0
    (file,) = tmp_path.glob(f"*/{pattern}")
    file.write_text(damage)
    done = _compiled_by_triton(tmp_path)
    assert done.returncode == FAILED
    said = done.stderr
    assert said.count("\n") == 1 and len(said) < 1000
    assert f"delete Triton's {tmp_path}" in said and "TRITON_CACHE_DIR" in said


def test_what_torch_cannot_read_names_both_caches(monkeypatch):
    """Raise inside of a function of torch's compiler, with a wrapper around, as torch does it."""
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", f"{os.sep}own")
    read = lambda text: compile(text, "cached.py", "exec")  # noqa: E731
    of_torch = types.FunctionType(read.__code__, {"__name__": "torch._inductor.codecache"})
    with pytest.raises(RuntimeError) as raised:
        try:
            of_torch("'cut")
        except SyntaxError as error:
            raise RuntimeError(f"backend='inductor' raised:\n{error}") from None
    line = explained(raised.value)
    assert line is not None and "\n" not in line
    assert "/own" in line and "TRITON_CACHE_DIR" in line and "unterminated" in line


def test_errors_of_others_are_left_alone():
    def fail():
        raise RuntimeError("own")

    with pytest.raises(RuntimeError) as raised:
        fail()
    assert explained(raised.value) is None
    assert explained(ValueError("never raised")) is None
