"""The guide to a robot of one's own, followed to the letter: it is installed, looked at, checked and trained."""

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.docs import guide

GUIDE = "add_a_robot.md"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that the guide's reader has after step 4, with its package installed beside it."""
    folder = tmp_path_factory.mktemp("stool")
    guide.write_files(GUIDE, folder)
    guide.install(folder, folder / "site")
    return folder


def run(folder: Path, *command: str) -> str:
    done = guide.run(*command, site=folder / "site", cwd=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def commands(prefix: str) -> list[str]:
    """The guide's commands that begin so, without that beginning."""
    return re.findall(rf"^    {prefix} (.*)$", (guide.DOCS / GUIDE).read_text(), re.MULTILINE)


@pytest.mark.full
def test_the_robot_stands_and_is_drawn(folder: Path) -> None:
    (script,) = commands("python")
    heights = re.findall(r"0\.\d+", run(folder, script).split("upright")[0])
    # Two links of 0.15 m and a foot's radius of 0.015 m are the most that straight legs reach.
    assert len(heights) == 4 and all(0.2 < float(height) < 0.315 for height in heights)
    picture = np.asarray(Image.open(folder / "stool.png"))
    seat = (picture[..., 0] > 1.5 * picture[..., 2]) & (picture[..., 0] > 60)
    assert seat.sum() > 500  # the red cushions


@pytest.mark.full
def test_its_unit_tests_pass(folder: Path) -> None:
    assert "2 passed" in run(
        folder, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_stool.py"
    )


@pytest.mark.full
def test_it_trains(folder: Path) -> None:
    (command,) = (command for command in commands("ksim-rl train") if "device=cuda" not in command)
    run(folder, "-m", "ksim_rl.cli.main", "train", *command.split())
    assert list(folder.glob("**/checkpoint"))


@pytest.mark.full
def test_it_is_explained(folder: Path) -> None:
    (command,) = commands("ksim-rl envs")
    assert "foot_clearance" in run(folder, "-m", "ksim_rl.cli.main", "envs", *command.split())


@pytest.mark.full
def test_the_report_is_what_the_guide_says(folder: Path) -> None:
    (command,) = commands("ksim-rl robot")
    out = run(folder, "-m", "ksim_rl.cli.main", "robot", *command.split())
    assert "stool: 5.70 kg" in out and "zero actions: stands 5 s" in out and "no armature" in out
    assert Image.open(folder / "stance.png").size == (640, 480)


def test_a_velocity_task_takes_at_most_40_lines() -> None:
    files = guide.files(GUIDE)
    assert (
        sum(
            files[name].count("\n")
            for name in ("stool/tasks.py", "stool/__init__.py", "pyproject.toml")
        )
        <= 40
    )


@pytest.mark.full
def test_the_robot_made_by_hand_weighs_what_its_model_does(folder: Path) -> None:
    script = "from stool.by_hand import TASK, ROBOT; TASK.cfg(); print(ROBOT.spec().compile().body_subtreemass[0])"
    assert float(run(folder, "-c", script)) == pytest.approx(5.7)
