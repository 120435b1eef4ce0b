"""The whole configuration of a training run: one dataclass tree whose groups mirror the rooms."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch

from ksim_rl.collectors import CollectorCfg
from ksim_rl.data import DatasetCfg
from ksim_rl.envs import ManagerBasedRlEnvCfg
from ksim_rl.envs.config_tree import from_tree, to_tree
from ksim_rl.modules import ActorCfg, CriticCfg
from ksim_rl.objectives import PPOCfg
from ksim_rl.trainers.loggers import LoggerCfg
from ksim_rl.trainers.trainer_cfg import TrainerCfg


@dataclass(frozen=True, kw_only=True)
class ModulesCfg:
    """The networks.

    Attributes:
        actor: the policy; reads the observation group `actor`.
        critic: the state value; reads the observation group `critic`.
    """

    actor: ActorCfg = field(default_factory=ActorCfg)
    critic: CriticCfg = field(default_factory=CriticCfg)


@dataclass(frozen=True, kw_only=True)
class RunCfg:
    """A training run.

    Attributes:
        task_name: the registered task that `task` began as; names the run and its threshold.
        num_envs: E, parallel envs.
        device: "cpu", "cuda", "cuda:<index>", or "auto" for CUDA where there is a GPU.
        seed: of all draws.
        task: the env.
    """

    task_name: str
    num_envs: int
    task: ManagerBasedRlEnvCfg
    data: DatasetCfg
    device: str = "auto"
    seed: int = 1
    collector: CollectorCfg = field(default_factory=CollectorCfg)
    objective: PPOCfg = field(default_factory=PPOCfg)
    modules: ModulesCfg = field(default_factory=ModulesCfg)
    trainer: TrainerCfg = field(default_factory=TrainerCfg)
    logger: LoggerCfg = field(default_factory=LoggerCfg)

    def __post_init__(self) -> None:
        """Refuse values that no run can have, before any model is compiled."""
        for name, low in (("num_envs", 1), ("seed", 0)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < low:
                raise ValueError(f"{name}={value!r}: expected a whole number >= {low}")
        if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", self.device):
            raise ValueError(f"device={self.device!r}: expected 'auto', 'cpu', 'cuda' or 'cuda:<index>'")
        if self.device.startswith("cuda") and not torch.cuda.is_available():
            raise ValueError(f"device={self.device!r}: torch finds no CUDA device here; use device=cpu")
        if self.task.scene.num_envs != self.num_envs:
            raise ValueError(
                f"task.scene.num_envs={self.task.scene.num_envs} differs from num_envs={self.num_envs}: "
                "set num_envs, which sets both"
            )
        missing = {"actor", "critic"} - set(self.task.observations)
        if missing:
            raise ValueError(
                f"task.observations has no group {sorted(missing)[0]!r}: networks read the groups 'actor' and 'critic'"
            )
        self.data.rollout_length(self.num_envs)

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any]) -> "RunCfg":
        """Build the config from plain data, such as a resolved Hydra config.

        Raises:
            ValueError: with the full path of the field that is unknown, missing, of a wrong type or out of range.
        """
        return from_tree(cls, tree)

    def to_tree(self) -> dict[str, Any]:
        """Return the config as plain data, from which `from_tree` builds an equal one."""
        return to_tree(self, type(self))

    def resolved_device(self) -> torch.device:
        """Return the device that "auto" stands for here."""
        if self.device == "auto":
            return torch.device("cuda" if torch.cuda.is_available() else "cpu")
        return torch.device(self.device)
