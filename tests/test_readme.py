"""The README's code runs as it stands and stays short."""

import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from ksim_rl import envs

README = Path(__file__).parents[1] / "README.md"


def block(kind: str) -> str:
    found = re.search(rf"<!-- test: {kind} -->\n```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert found, f"README has no block marked <!-- test: {kind} -->"
    return found.group(1)


@pytest.mark.parametrize(("kind", "limit"), [("python", 40), ("pytest", 20), ("term", 20), ("adapters", 5)])
def test_the_blocks_are_short(kind, limit):
    assert len(block(kind).splitlines()) <= limit


def test_the_python_block_runs_as_it_stands(tmp_path):
    script = tmp_path / "composed.py"
    script.write_text(block("python"))
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("reward per step") == 3


def test_the_unit_test_passes_as_it_stands(tmp_path):
    (tmp_path / "test_copied.py").write_text(block("pytest"))
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_copied.py"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0 and "1 passed" in done.stdout, done.stdout + done.stderr


def test_the_term_rewards_the_middle_of_the_rail():
    names = {"__name__": "ksim_rl_readme"}
    exec(compile(block("term"), "README.md: term", "exec", dont_inherit=True), names)  # noqa: S102
    cfg = envs.make_cfg("cartpole_balance", ["task.scene.num_envs=2"])
    env = envs.build(dataclasses.replace(cfg, rewards={"centered": names["Centered"]()}))
    rollout_ET = env.rollout(3)
    cart_ET = rollout_ET["next", "actor"][..., 0]
    torch.testing.assert_close(rollout_ET["next", "reward"][..., 0], torch.exp(-cart_ET.square()))


def test_the_env_of_another_library_resets():
    names = {}
    exec(compile(block("adapters"), "README.md: adapters", "exec"), names)  # noqa: S102
    assert names["env"].reset().shape == (64, 5)
