"""Algorithms are found by name and by the class of their settings, and other packages bring their own."""

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from ksim_rl import algorithms
from ksim_rl.algorithms import registry
from ksim_rl.objectives import AlgorithmCfg, AMPCfg, PPOCfg, SACCfg
from ksim_rl.trainers.run_cfg import RunCfg
from tests.algorithms import plugin

SMALL = (
    "task=cartpole_balance",
    "num_envs=8",
    "data.num_env_states_per_minibatch=64",
    "data.num_minibatches=2",
    "modules.actor.hidden_dims=[16]",
    "trainer.num_iterations=2",
    "trainer.eval_episodes=2",
    "trainer.video=false",
    "task.episode_length_s=0.3",
    "logger=none",
    "device=cpu",
)
ENTRY_POINTS = """
[ksim_rl.algorithms]
mine = my_learning

[ksim_rl.conf]
mine = my_learning.conf
"""


def test_ours_are_there_by_name():
    ours = ["amp", "bc", "distillation", "fast_sac", "fast_td3", "ppo", "sac", "td3"]
    assert [name for name in algorithms.names() if name != "mine"] == ours
    assert algorithms.algorithm("amp").cfg is AMPCfg
    with pytest.raises(ValueError, match="fast_sca.*did you mean 'fast_sac'"):
        algorithms.algorithm("fast_sca")


def test_a_subclass_inherits_the_algorithm_of_its_nearest_base():
    @dataclass(frozen=True, kw_only=True)
    class Gentle(AMPCfg):
        entropy_coeff: float = 0.001

    assert registry.serving(Gentle).name == "amp" and registry.serving(PPOCfg).name == "ppo"
    assert registry.serving(SACCfg).name == "sac"
    with pytest.raises(ValueError, match="objective is a AlgorithmCfg, which no algorithm serves"):
        registry.serving(AlgorithmCfg)


def test_two_of_one_name_are_refused():
    registry.register(algorithms.algorithm("ppo"))
    other = algorithms.Algorithm(
        name="ppo",
        cfg=plugin.MineCfg,
        update=plugin.MineUpdate,
        policy=plugin.make_ppo_policy,
        data=plugin.DATA,
    )
    with pytest.raises(ValueError, match="two algorithms are called 'ppo'.*rename one"):
        registry.register(other)


def test_trainers_name_no_algorithm():
    names = [name for name in algorithms.names() if name != "mine"]
    for path in Path(sys.modules[RunCfg.__module__].__file__).parent.rglob("*.py"):
        words = path.read_text().replace("_", " ").lower().split()
        assert not [name for name in names if name in words], path


def write_package(site):
    """Write the package, in which one file is all of the algorithm."""
    package = site / "my_learning"
    (package / "conf" / "objective").mkdir(parents=True)
    source = Path(plugin.__file__).read_text()
    assert source.count("\n") <= 60
    (package / "__init__.py").write_text(source)
    (package / "conf" / "__init__.py").write_text("")
    (package / "conf" / "objective" / "slow.yaml").write_text(
        "defaults: [mine]\nlearning_rate: 1.0e-5\n"
    )
    return site


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Install the package, as a wheel would, where only a subprocess sees it."""
    site = write_package(tmp_path_factory.mktemp("site"))
    info = site / "my_learning-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my_learning\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    return site


def ksim_rl(site, *arguments):
    paths = os.pathsep.join([str(site), str(Path(__file__).parents[2])])
    return subprocess.run(
        [sys.executable, "-m", "ksim_rl.cli.main", *arguments],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": paths},
    )


@pytest.mark.full
def test_an_algorithm_from_another_package_trains(site, tmp_path):
    words = (*SMALL, "trainer.warm_up=true", f"hydra.run.dir={tmp_path / 'run'}")
    done = ksim_rl(site, "train", "objective=mine", *words)
    assert done.returncode in (0, 1), done.stderr
    assert "2 iterations" in done.stdout
    # An option that does nothing says so.
    assert done.stdout.count("MineUpdate has no warm_up(rollout_ET)") == 1


@pytest.mark.full
def test_a_run_of_another_package_is_resumed_and_evaluated(site, tmp_path):
    ksim_rl(site, "train", "objective=mine", *SMALL, f"hydra.run.dir={tmp_path / 'run'}")
    resumed = ksim_rl(site, "resume", str(tmp_path / "run"), "--num-iterations", "3")
    assert resumed.returncode in (0, 1) and "3 iterations" in resumed.stdout, resumed.stderr
    judged = ksim_rl(site, "eval", str(tmp_path / "run"), "--episodes", "2")
    assert "cartpole_balance, iteration 3: evaluation over 2 episodes" in judged.stdout, (
        judged.stderr
    )


@pytest.mark.full
def test_a_plugin_is_named_and_its_settings_are_varied_like_ours(tmp_path):
    site, named = write_package(tmp_path), ("--plugin", "my_learning")
    shown = ksim_rl(
        site, "train", *named, "objective=slow", *SMALL, "--cfg", "job", "--package", "objective"
    )
    assert (
        "_target_: my_learning.MineCfg" in shown.stdout and "learning_rate: 1.0e-05" in shown.stdout
    )
    wrong = ksim_rl(site, "train", *named, "objective=mine", "objective.learning_rat=1", *SMALL)
    assert wrong.returncode == 2 and "did you mean 'learning_rate'" in wrong.stderr
    unknown = ksim_rl(site, "train", "objective=mine", *SMALL)
    assert unknown.returncode == 2 and "unknown objective 'mine'" in unknown.stderr
