"""`ksim-rl robot` prints what `analyse` finds, as a table or as code, and says by its code whether the robot stands."""

import numpy as np
import pytest
from PIL import Image

from ksim_rl.cli import main
from ksim_rl.scene.rendering import rendering
from ksim_rl.tasks.velocity import VelocityTask
from tests.scene.robots.test_analysis import biped


@pytest.fixture
def run(tmp_path, capsys):
    def run(*flags, xml=None):
        path = tmp_path / "tin_man.xml"
        path.write_text(biped() if xml is None else xml)
        with pytest.raises(SystemExit) as stopped:
            main.main(["robot", str(path), *flags])
        said = capsys.readouterr()
        return stopped.value.code, said.out, said.err

    return run


def test_the_report_names_what_was_found(run):
    code, out, _ = run()
    assert code == 0
    for part in (
        "tin_man: 20.00 kg",
        "feet: left_foot, right_foot",
        "stands 5 s",
        "njmax=",
        "left_hip_roll",
        "none",
    ):
        assert part in out


def test_the_code_runs_and_makes_a_task(run):
    code, out, _ = run("--code")
    scope: dict = {}
    exec(out, scope)  # noqa: S102
    assert code == 0 and isinstance(scope["TASK"], VelocityTask)
    assert scope["TASK"].name == "tin_man_velocity_flat" and scope["TIN_MAN"].root_body == "torso"


def test_a_robot_that_cannot_stand_says_so_by_the_exit_code(run):
    weak = '<motor joint="left_knee" ctrlrange="-1 1"/><motor joint="right_knee" ctrlrange="-1 1"/>'
    code, out, _ = run(xml=biped(actuators=weak))
    assert code == 1 and "stands 0." in out


def test_the_picture_shows_the_robot_on_its_floor(run, tmp_path):
    try:
        rendering.choose_gl_platform()
    except RuntimeError as error:
        pytest.skip(f"no OpenGL here: {error}")
    path = tmp_path / "stance.png"
    code, _, err = run("--picture", str(path))
    assert code == 0, err
    picture = np.asarray(Image.open(path), dtype=float)
    assert picture.shape[:2] == (480, 640)
    # It stands in the middle, where the picture differs from column to column; the sides show ground alone.
    middle, side = picture[:, 240:400], picture[:, :40]
    assert middle.std(axis=1).mean() > 3.0 * side.std(axis=1).mean()


def test_mistakes_are_one_line(run):
    assert run("--picture", "x.gif")[::2] == (
        2,
        "ksim-rl: error: --picture x.gif: expected a file that ends in .png\n",
    )
    code, _, err = run(xml=biped(root=""))
    assert code == 2 and err.count("\n") == 1 and "0 free joints" in err
