"""Limits under which libraries crash, a working directory that is gone."""

import os
import resource
import subprocess
import sys

import pytest

COMMAND = (
    "-P",
    "-c",
    "import sys; sys.argv[0] = 'ksim-rl'; from ksim_rl.cli.main import main; main()",
)


def run(words, **options):
    command = [sys.executable, *COMMAND, *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, **options)


@pytest.mark.parametrize(
    ("kind", "most", "named"),
    [
        (resource.RLIMIT_AS, 300 * 2**20, "ulimit -v"),
        (resource.RLIMIT_DATA, 300 * 2**20, "ulimit -d"),
        (resource.RLIMIT_STACK, 600 * 2**10, "ulimit -s"),
    ],
)
def test_a_limit_under_which_libraries_crash_is_refused_in_one_line(kind, most, named):
    ended = run(["envs"], preexec_fn=lambda: resource.setrlimit(kind, (most, most)))
    assert ended.returncode == 2
    assert named in ended.stderr and ended.stderr.count("\n") == 1


def test_python_without_docstrings_is_refused_in_one_line():
    ended = run(["envs"], env={**os.environ, "PYTHONOPTIMIZE": "2"})
    assert ended.returncode == 2
    assert "PYTHONOPTIMIZE" in ended.stderr and ended.stderr.count("\n") == 1


def test_usage_needs_no_room():
    limit = 300 * 2**20
    ended = run(
        ["--help"], preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    )
    assert ended.returncode == 0 and "usage: ksim-rl" in ended.stdout


def test_a_working_directory_that_is_gone_is_said(tmp_path):
    ended = run(["envs"], cwd=tmp_path, preexec_fn=tmp_path.rmdir)
    assert ended.returncode == 2
    assert "the working directory" in ended.stderr and ended.stderr.count("\n") == 1
