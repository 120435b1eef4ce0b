"""A registered task's env, put into states whose rewards are known."""

from collections.abc import Mapping

import torch
from torch import Tensor

from ksim_rl import envs
from ksim_rl.envs.term import RewardTerm


class Placed:
    """A few worlds of a task, without transforms."""

    def __init__(self, name: str, num_envs: int) -> None:
        self.env = envs.make(name, num_envs=num_envs, seed=0).base_env
        self.driver = self.env.driver
        self.view, self.world, self.model = self.env.view, self.env.world, self.env.world.mj_model
        self.env.reset()

    def set(
        self,
        qpos: Mapping[str, float | list[float]],
        qvel: Mapping[str, float | list[float]] | None = None,
    ) -> None:
        """Start from the default pose at rest, and set some joints by name, one value or one per env."""
        self.world.qpos_EL.copy_(self.view.default_qpos_L.expand_as(self.world.qpos_EL))
        self.world.qvel_EL.zero_()
        for name, value in qpos.items():
            self.world.qpos_EL[:, int(self.model.joint(name).qposadr[0])] = torch.tensor(value)
        for name, value in (qvel or {}).items():
            self.world.qvel_EL[:, int(self.model.joint(name).dofadr[0])] = torch.tensor(value)
        self.world.refresh()
        self.driver.refreshed()

    def reward(self, term: RewardTerm) -> Tensor:
        with self.driver.scope("rewards/x"):
            return term(self.view)
