"""A wheel in a clean environment, as `pip install` alone leaves it."""

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parent.parent
# Of processors, so that a busy machine counts as an idle one.
SECONDS_TO_PLAY = 60.0


@pytest.fixture(scope="module")
def command(tmp_path_factory) -> Path:
    """Install a new wheel with its dependencies into an environment of its own, and return its `ksim-rl`."""
    folder = tmp_path_factory.mktemp("clean")
    build = [
        sys.executable,
        "-m",
        "build",
        "--no-isolation",
        "--wheel",
        "--outdir",
        str(folder),
        str(ROOT),
    ]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    subprocess.run([sys.executable, "-m", "venv", str(folder / "venv")], check=True)
    scripts = folder / "venv" / "bin"
    install = [
        scripts / "python",
        "-m",
        "pip",
        "install",
        "--quiet",
        "-c",
        ROOT / "constraints.txt",
        wheel,
    ]
    subprocess.run(install, check=True)
    return scripts / "ksim-rl"


@pytest.mark.full
def test_a_policy_of_the_zoo_plays_within_a_minute_of_the_install(command, tmp_path):
    # A home of its own, so that nothing is found that an earlier start has compiled.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment |= {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    play = [command, "play", "zoo:quadruped", "--seconds", "2", "--device", "cpu"]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [*play, "--output", tmp_path / "play.mp4"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 0, done.stderr
    seconds = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    assert seconds < SECONDS_TO_PLAY
    assert (tmp_path / "play.mp4").stat().st_size > 10_000


def test_a_tag_becomes_a_release_with_the_wheel():
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yml").read_text())
    # YAML reads the key `on` as a truth value.
    assert workflow[True] == {"push": {"tags": ["v*"]}}
    commands = [step.get("run", "") for step in workflow["jobs"]["release"]["steps"]]
    build, trial, release = commands[3:]
    assert build.startswith("make dist")
    assert "tests/test_installed_wheel.py" in trial
    assert release.startswith('gh release create "$GITHUB_REF_NAME" dist/*.whl')
