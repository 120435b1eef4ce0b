"""An env that only hands out numbers: what a step costs beyond it is the transforms'."""

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

TERMS = {"joint_pos": 16, "joint_vel": 16, "gravity": 16}
NUM_ACTIONS = 12


class WideEnv(EnvBase):
    """E envs with an observation of 48 numbers, and the same in three terms; no episode ends."""

    def __init__(self, num_envs: int, *, device: torch.device) -> None:
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        sizes = {"observation": sum(TERMS.values()), **TERMS}
        self.observation_spec = Composite(
            {
                name: Unbounded(torch.Size([num_envs, size]), device=device)
                for name, size in sizes.items()
            },
            shape=(num_envs,),
            device=device,
        )
        self.full_action_spec = Composite(
            action=Bounded(-1.0, 1.0, torch.Size([num_envs, NUM_ACTIONS]), device=device),
            shape=(num_envs,),
            device=device,
        )
        self.full_reward_spec = Composite(
            reward=Unbounded(torch.Size([num_envs, 1]), device=device),
            shape=(num_envs,),
            device=device,
        )
        generator = torch.Generator(device=device).manual_seed(0)
        self._values = {
            name: torch.randn(num_envs, size, generator=generator, device=device)
            for name, size in sizes.items()
        }
        self._reward = torch.ones(num_envs, 1, device=device)
        self._no = torch.zeros(num_envs, 1, dtype=torch.bool, device=device)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._answer(reward=self._reward)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        return self._answer()

    def _answer(self, **leaves: torch.Tensor) -> TensorDictBase:
        flags = {name: self._no.clone() for name in ("done", "terminated")}
        return TensorDict(
            {**self._values, **flags, **leaves}, batch_size=self.batch_size, device=self.device
        )

    def _set_seed(self, seed: int | None) -> None:
        pass
