"""The folder of a stranger and what lies around it, and the registry of what strangers put there."""

import copy
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
import yaml
from omegaconf import OmegaConf

from ksim_rl.cli import main
from ksim_rl.trainers import checkpoint

SECRET = "a-token-that-nobody-may-see"
SMALL = ("num_envs=16", "data.num_env_states_per_minibatch=32", "logger.tensorboard=false")


@dataclass(frozen=True)
class Place:
    """A stranger's run folder, and a folder outside of it that nothing may touch."""

    run: Path
    outside: Path
    tree: dict

    @property
    def expression(self) -> str:
        """What does the same where an expression is evaluated that Hydra's own blocklist lets through."""
        return f"__import__('os').system('touch {self.outside / 'executed'}')"

    @property
    def code(self) -> str:
        """Python code that leaves a mark outside."""
        return f"open({str(self.outside / 'executed')!r}, 'w').close()"

    def write_config(self, text: str = "", **more) -> list[str]:
        """Write config.yaml with `more` at its top; return the command that makes the run once more."""
        tree = {**copy.deepcopy(self.tree), **more}
        (self.run / "config.yaml").write_text(yaml.safe_dump(tree, sort_keys=False) + text)
        return ["train", "--config-dir", str(self.run), f"hydra.run.dir={self.run.parent / 'new'}"]

    def write_checkpoint(self, state: dict | None = None, **more) -> list[str]:
        """Write a checkpoint whose manifest has a config with `more` at its top; return the command that reads it."""
        config = {**copy.deepcopy(self.tree), **more}
        checkpoint.save(
            self.run / "checkpoint", state or {"x": torch.zeros(1)}, iteration=1, config=config
        )
        return ["eval", str(self.run)]


def as_a_run_would(cfg, folder, resume_from=None):
    """Write what a run writes before it trains, at the same places."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(cfg.to_tree())))
    if "KSIM_RL_MARK" in os.environ:
        (folder / "environment").write_text(SECRET)
    if cfg.task.sim.nan_guard is not None:
        Path(cfg.task.sim.nan_guard.folder).mkdir(parents=True)
    if cfg.viewer.browser:  # a port is opened, which lets in who reaches it
        (folder / "environment").write_text(SECRET)
    if cfg.logger.mlflow is not None:
        Path(cfg.logger.mlflow.tracking_uri.removeprefix("sqlite:///")).write_text("")
    return 0


FAMILIES: dict[str, tuple[Callable, Callable]] = {}


def family(without):
    """Register what writes a payload, with what removes its check from the build."""

    def register(write):
        FAMILIES[write.__name__] = (write, without)
        return write

    return register


def call(arguments):
    with pytest.raises(SystemExit) as stopped:
        main.main(arguments)
    return stopped.value.code


def signs(place, shown: str) -> list[str]:
    """Return what a payload has done: marks outside, a changed environment, a secret in files or on the terminal."""
    found = [str(path) for path in place.outside.rglob("*") if path.name in ("executed", "written")]
    base = place.run.parent
    read = [path.read_text(errors="replace") for path in base.rglob("*") if path.is_file()]
    return found + ["secret"] * any(SECRET in text for text in [shown, *read])
