"""A package of the user's: named on the command line, remembered by the run folder, imported only where it is named."""

import os
import subprocess
import sys

import pytest
import torch
import yaml

from ksim_rl.cli import main
from ksim_rl.trainers import load_policy
from tests.cli.test_train import SMALL

PACKAGE = {
    "__init__.py": "",
    "__main__.py": "raise SystemExit('a plug-in is imported, not run')",
    "terms.py": """
from dataclasses import dataclass
import torch
from jaxtyping import Float
from torch import Tensor
from torchrl.envs.transforms import Transform
from ksim_rl.envs import EnvView, RewardTerm

@dataclass(frozen=True, kw_only=True)
class Alive(RewardTerm):
    weight: float = 1.0
    bonus: float

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return torch.full((view.num_envs,), self.bonus, device=view.device)

class Negate(Transform):
    def __init__(self, key: str = "actor") -> None:
        super().__init__(in_keys=[key], out_keys=[key])

    def _apply_transform(self, obs):
        return -obs

    def _reset(self, tensordict, tensordict_reset):
        return self._call(tensordict_reset)
""",
    "tasks.py": """
import dataclasses
from ksim_rl import envs

def cfg():
    return envs.task("cartpole_swingup").cfg()

MINE = dataclasses.replace(envs.task("cartpole_swingup"), name="my_swingup", cfg=cfg, solved_at=None)
""",
    "conf/__init__.py": "",
    "conf/experiment/brief.yaml": "# @package _global_\ntrainer:\n  num_iterations: 1\n",
}
NODES = (
    "+task.rewards.alive={_target_: mine_of_test.terms.Alive, bonus: 0.5}",
    "+task.transforms.negate={_target_: mine_of_test.terms.Negate}",
)


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """Make a working directory with the package in it, not installed."""
    folder = tmp_path_factory.mktemp("work")
    for name, text in PACKAGE.items():
        path = folder / "mine_of_test" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


def ksim_rl(work, *arguments, **environment):
    # As the console script does it: unlike with -m, the working directory is not on the path.
    code = "import sys; from ksim_rl.cli.main import main; sys.path.remove(''); main()"
    command = [sys.executable, "-c", code, *arguments]
    given = {**os.environ, "PYTHONPATH": os.getcwd(), **environment}
    return subprocess.run(command, cwd=work, env=given, capture_output=True, text=True)


@pytest.fixture
def refused(work, monkeypatch, capsys):
    """Return what runs a command of this process in that directory, and gives its one line of refusal."""

    def run(*arguments):
        with pytest.raises(SystemExit) as stopped:
            main.main(list(arguments))
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert stopped.value.code == 2
        return line

    monkeypatch.chdir(work)
    monkeypatch.setattr(sys, "path", [*sys.path])
    return run


@pytest.fixture(scope="module")
def trained(work):
    arguments = [
        "task=my_swingup",
        "+experiment=brief",
        *NODES,
        *SMALL,
        "task.sim.engine=c",
        "trainer.video=false",
        "hydra.run.dir=run",
    ]
    done = ksim_rl(work, "train", "--plugin", "mine_of_test", *arguments)
    assert done.returncode == 0, done.stderr[-2000:]
    return work / "run"


def test_its_classes_task_and_configs_are_used_and_its_name_is_remembered(trained):
    config = yaml.safe_load((trained / "config.yaml").read_text())
    assert config["plugins"] == ["mine_of_test"]
    assert config["task_name"] == "my_swingup"
    assert config["trainer"]["num_iterations"] == 1
    assert config["task"]["rewards"]["alive"]["_target_"] == "mine_of_test.terms.Alive"
    assert list(config["task"]["transforms"]) == ["negate"]


@pytest.mark.parametrize("command", ["eval", "resume", "play"])
def test_a_remembered_plug_in_is_not_imported_until_it_is_named(refused, trained, command):
    line = refused(command, "run")
    assert "this run was made with the plug-in 'mine_of_test', which is not loaded" in line
    assert "--plugin mine_of_test" in line
    assert "mine_of_test" not in sys.modules


@pytest.mark.full
def test_it_is_named_by_the_flag_or_by_the_users_settings(work, trained):
    done = ksim_rl(work, "eval", "run", "--episodes", "2", "--plugin=mine_of_test")
    assert done.returncode == 0, done.stderr[-2000:]
    assert "my_swingup, iteration 1" in done.stdout
    assert f"taken from {work}, where Python finds modules from now on" in done.stderr
    done = ksim_rl(work, "envs", KSIM_RL_PLUGINS="mine_of_test", KSIM_RL_PLUGIN_PATH=str(work))
    assert "my_swingup" in done.stdout


def test_a_plug_in_that_does_not_exist_is_refused(refused):
    assert "plug-in 'mine_of_tset' cannot be loaded" in refused("envs", "--plugin", "mine_of_tset")
    assert "plug-in 'mine_of_tset' cannot be loaded" in refused("--plugin", "mine_of_tset", "envs")
    assert "--plugin: expected the name" in refused("envs", "--plugin")


def test_only_the_flag_takes_a_plug_in_from_the_working_directory(refused, work, monkeypatch):
    """A variable that is set for all commands also counts in the folder of a stranger."""
    monkeypatch.setenv("KSIM_RL_PLUGINS", "mine_of_test")
    for path in ("", ".", f":{os.path.relpath(work)}"):
        monkeypatch.setenv("KSIM_RL_PLUGIN_PATH", path)
        assert "plug-in 'mine_of_test' cannot be loaded: ModuleNotFoundError" in refused("envs")
        assert str(work) not in sys.path and "mine_of_test" not in sys.modules


def test_python_names_it_for_a_policy(work, trained, monkeypatch):
    monkeypatch.chdir(work)
    monkeypatch.syspath_prepend(str(work))
    monkeypatch.setenv("KSIM_RL_PLUGINS", "")
    with pytest.raises(ValueError, match="--plugin mine_of_test"):
        load_policy(trained, device="cpu")
    from ksim_rl.config import plugins

    monkeypatch.setattr(plugins, "_named", [])
    policy = load_policy(trained, device="cpu", plugins=["mine_of_test"])
    assert type(policy.cfg.task.rewards["alive"]).__name__ == "Alive"
    assert all(torch.isfinite(p).all() for p in policy.actor.parameters())
