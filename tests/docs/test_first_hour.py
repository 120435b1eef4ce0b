"""The first hour's task builds as the page has it, is mended by the page's change, and trains from a command."""

import re
import shlex
import sys
import types
from pathlib import Path

import pytest

from ksim_rl import envs
from ksim_rl.testing import check_env
from tests.docs import guide

PAGE = (guide.DOCS / "first_hour.md").read_text()
CHANGES = dict(re.findall(r"<!-- change: (\w+) -->\n```python\n(.*?)```", PAGE, re.DOTALL))
NAME = "gentle"


@pytest.fixture
def gentle():
    module = types.ModuleType(NAME)
    # Configs may name the classes of a package that is imported and allowed.
    sys.modules[NAME] = module
    exec(compile(guide.files("first_hour.md")["gentle.py"], "gentle.py", "exec"), vars(module))  # noqa: S102
    yield module
    del sys.modules[NAME]


def test_the_first_version_has_no_reward_for_staying_up(gentle) -> None:
    assert list(gentle.TASK.cfg().rewards) == ["force"]


@pytest.mark.full
def test_the_mended_version_keeps_the_contract_and_the_original_reward(gentle) -> None:
    exec(compile(CHANGES["cartpole_gentle"], "gentle.py", "exec"), vars(gentle))  # noqa: S102
    cfg = gentle.cartpole_gentle()
    assert list(cfg.rewards) == ["balance", "force"]
    check_env(envs.build(cfg))


@pytest.mark.full
def test_the_commands_train_both_versions_and_compare_them(tmp_path: Path) -> None:
    guide.write_files("first_hour.md", tmp_path)
    small = [
        "num_envs=16",
        "trainer.num_iterations=2",
        "trainer.eval_episodes=2",
        "trainer.video=false",
    ]
    commands = re.findall(r"^    ksim-rl (train [^\\\n]*(?:\\\n.*)?)$", PAGE, re.MULTILINE)
    assert len(commands) == 2
    for command in commands:
        words = shlex.split(command.replace("\\\n", " "))
        done = guide.run("-m", "ksim_rl.cli.main", *words, *small, site=tmp_path, cwd=tmp_path)
        # Two iterations solve nothing, which the exit code says, too.
        assert done.returncode == 1 and "NOT SOLVED" in done.stdout, done.stdout + done.stderr
    done = guide.run(
        "-m",
        "ksim_rl.cli.main",
        "compare",
        "runs/first",
        "runs/second",
        site=tmp_path,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
