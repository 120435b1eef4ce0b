"""The guide to a task of one's own, followed to the letter: its package is installed and its task trained."""

import re
import subprocess
from pathlib import Path
from typing import Any

import pytest

from ksim_rl.config import config_tree
from tests.docs import guide


class Installed:
    """A copy of the guide's package, installed where only `run` sees it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.site = folder / "puck_rink", folder / "site"
        guide.write_files("own_task.md", self.folder)
        self.install()

    def install(self) -> None:
        guide.install(self.folder, self.site)

    def run(self, *command: str | Path) -> subprocess.CompletedProcess[str]:
        return guide.run(*command, site=self.site, cwd=self.folder.parent)

    def ksim_rl(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        return self.run("-m", "ksim_rl.cli.main", *arguments)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    return Installed(tmp_path_factory.mktemp("own_task"))


@pytest.mark.full
def test_the_task_is_listed_with_ours(installed: Installed) -> None:
    done = installed.ksim_rl("envs")
    assert done.returncode == 0, done.stderr
    assert "puck_center" in done.stdout and "cartpole_balance" in done.stdout


@pytest.mark.full
def test_its_unit_test_passes(installed: Installed) -> None:
    done = installed.run(
        "-m", "pytest", "-q", "-p", "no:cacheprovider", installed.folder / "test_puck.py"
    )
    assert done.returncode == 0 and "1 passed" in done.stdout, done.stdout + done.stderr


@pytest.mark.full
def test_training_takes_overrides_of_its_terms_and_its_own_configs(installed: Installed) -> None:
    done = installed.ksim_rl(
        "train",
        "task=puck_center",
        "+experiment=heavy",
        "task.rewards.near_center.std=0.3",
        "--cfg",
        "job",
    )
    assert done.returncode == 0, done.stderr
    assert (
        "mass: 2.0" in done.stdout
        and "std: 0.3" in done.stdout
        and "num_iterations: 60" in done.stdout
    )


@pytest.mark.full
def test_misspelt_overrides_of_its_terms_and_configs_are_refused(installed: Installed) -> None:
    unknown = installed.ksim_rl("train", "task=puck_center", "task.rewards.near_center.sdt=0.3")
    assert unknown.returncode == 2 and "did you mean" in unknown.stderr
    lacking = installed.ksim_rl("train", "task=puck_center", "+experiment=light")
    assert lacking.returncode == 2 and "heavy" in lacking.stderr


@pytest.mark.full
def test_it_trains_until_solved(installed: Installed) -> None:
    done = installed.ksim_rl("train", "task=puck_center", "trainer.video=false", "seed=1")
    assert done.returncode == 0 and "SOLVED" in done.stdout, done.stdout + done.stderr


def test_without_the_package_its_classes_are_not_built() -> None:
    tree = {"_target_": "puck_rink.robot.Puck"}
    with pytest.raises(ValueError, match="only classes of these packages are built: ksim_rl"):
        config_tree.from_tree(object, tree, "x")


@pytest.mark.full
def test_a_broken_package_is_named(tmp_path: Path) -> None:
    broken = Installed(tmp_path)
    (broken.folder / "puck_rink" / "tasks.py").write_text("import no_such_module\n")
    broken.install()
    done = broken.ksim_rl("envs")
    assert done.returncode == 2
    assert (
        "puck_rink" in done.stderr
        and "no_such_module" in done.stderr
        and "uninstall" in done.stderr
    )


@pytest.mark.full
def test_a_name_that_is_taken_is_refused(tmp_path: Path) -> None:
    rival = Installed(tmp_path)
    tasks = rival.folder / "puck_rink" / "tasks.py"
    tasks.write_text(tasks.read_text().replace('name="puck_center"', 'name="cartpole_balance"'))
    rival.install()
    done = rival.ksim_rl("envs")
    assert done.returncode == 2
    assert "two tasks are called 'cartpole_balance'" in done.stderr and "rename one" in done.stderr


def test_its_env_is_made_in_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    guide.write_files("own_task.md", tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    text = (guide.DOCS / "own_task.md").read_text()
    (example,) = re.findall(
        r"<!-- example: env_in_python -->\n```python\n(.*?)```", text, re.DOTALL
    )
    names: dict[str, Any] = {}
    exec(compile(example, "docs/own_task.md", "exec"), names)  # noqa: S102
    assert names["env"].batch_size[0] == 256
