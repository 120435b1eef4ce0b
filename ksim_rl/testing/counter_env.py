"""A probe env whose every answer is known in closed form."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from ksim_rl import dims
from ksim_rl.device import random


class CounterEnv(EnvBase):
    """Env e counts its own steps and ends after `lengths[e]` of them; a plain `EnvBase`, with masked `_reset`.

    Observations ([E, 1] float32 unless stated): "count" (steps since the reset), "episode" (resets so far), "row" (its
    own number), "drawn" (uniform on [0, 1), drawn at the reset from seed, row and episode), and ("obs", "vector") [E,
    3] = count + (0, 100, 200). With the H, W, C of a `picture` also "rgb" (uint8 [E, H, W, C]): 40 * count + the number
    of the byte in its picture, modulo 256. Reward is the action's sum. Even rows terminate, odd rows are truncated.
    Without `lengths` it is one env with batch size [] that ends after 3 steps.
    """

    count_E: Tensor
    episode_E: Tensor
    seed_value: Tensor
    length_E: Tensor
    row_E: Tensor
    offset_L: Tensor
    byte_HWC: Tensor | None

    def __init__(
        self,
        lengths: Sequence[int] = (3, 5, 4),
        *,
        action_size: int = 2,
        picture: Sequence[int] | None = None,
        device: Any = "cpu",
    ) -> None:
        batch = torch.Size([len(lengths)] if lengths else [])
        super().__init__(device=torch.device(device), batch_size=batch)
        self.num_rows = max(1, len(lengths))
        length_E = torch.tensor(list(lengths) or [3])
        # Buffers, so that `state_dict` has them and a copy to a device moves them.
        counters = {name: torch.zeros_like(length_E) for name in ("count_E", "episode_E")}
        counters |= {
            "length_E": length_E,
            "seed_value": torch.tensor(0),
            "row_E": torch.arange(self.num_rows),
        }
        # The number of each byte; a buffer, as it moves with the others.
        byte_HWC = None if picture is None else torch.arange(math.prod(picture)).view(*picture)
        self.register_buffer("byte_HWC", None if byte_HWC is None else byte_HWC.to(device))
        for name, held in {**counters, "offset_L": torch.tensor([0.0, 100.0, 200.0])}.items():
            self.register_buffer(name, held.to(device))
        scalar = Unbounded(1)
        flag = Binary(1, dtype=torch.bool)
        specs = {
            "observation": {
                **{name: scalar.clone() for name in ("count", "episode", "row")},
                "drawn": Bounded(0.0, 1.0, torch.Size([1])),
                "obs": Composite(vector=Unbounded(3)),
            },
            "action": {"action": Bounded(-1.0, 1.0, torch.Size([action_size]))},
            "reward": {"reward": scalar},
            "done": {name: flag.clone() for name in ("done", "terminated", "truncated")},
        }
        if byte_HWC is not None:
            specs["observation"]["rgb"] = Bounded(0, 255, byte_HWC.shape, dtype=torch.uint8)
        for which, leaves in specs.items():
            # All specs are made for one row, then expanded to the batch.
            spec = Composite(leaves).expand(batch).to(self.device)
            spec.names = [dims.E] * len(batch)
            setattr(self, f"full_{which}_spec", spec)

    def _observe(self) -> dict[str, Any]:
        # Keyed by row and episode: a partial reset draws the same as a reset of all.
        keys = random.row_keys(self.seed_value, 1, self.episode_E, self.num_rows)
        count_E1 = self.count_E[:, None].float()
        batch = self.batch_size
        values: dict[str, Any] = {
            "count": count_E1.reshape(*batch, 1),
            "episode": self.episode_E.float().reshape(*batch, 1),
            "row": self.row_E.float().reshape(*batch, 1),
            "drawn": random.uniform(keys, 1).reshape(*batch, 1),
            "obs": TensorDict(
                {"vector": (count_E1 + self.offset_L).reshape(*batch, 3)}, batch, device=self.device
            ),
        }
        if self.byte_HWC is not None:
            rgb_EHWC = 40 * self.count_E[:, None, None, None] + self.byte_HWC
            values["rgb"] = (rgb_EHWC % 256).to(torch.uint8).reshape(*batch, *self.byte_HWC.shape)
        return values

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action")
        if action.shape != self.action_spec.shape or action.dtype != self.action_spec.dtype:
            raise ValueError(
                f"action has shape {tuple(action.shape)} and dtype {action.dtype}: "
                f"expected {tuple(self.action_spec.shape)} and {self.action_spec.dtype}"
            )
        self.count_E.add_(1)
        ended_E = self.count_E >= self.length_E
        # Both kinds of end occur, each in known rows.
        even_E = self.row_E % 2 == 0
        flags = {"done": ended_E, "terminated": ended_E & even_E, "truncated": ended_E & ~even_E}
        values = self._observe() | {k: v.reshape(*self.batch_size, 1) for k, v in flags.items()}
        values["reward"] = action.sum(-1, keepdim=True)
        return TensorDict(values, batch_size=self.batch_size, device=self.device)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        if tensordict is None:
            mask = None
        else:
            mask = tensordict.get("_reset", None)
        # TorchRL's plain reset gives no mask.
        if mask is None:
            mask_E = torch.ones_like(self.count_E, dtype=torch.bool)
        else:
            mask_E = mask.reshape(-1)
        # Only the rows of the mask, which may be empty.
        self.count_E.copy_(torch.where(mask_E, 0, self.count_E))
        self.episode_E.add_(mask_E)
        flag = torch.zeros((*self.batch_size, 1), dtype=torch.bool, device=self.device)
        values = self._observe() | {
            "done": flag,
            "terminated": flag.clone(),
            "truncated": flag.clone(),
        }
        return TensorDict(values, batch_size=self.batch_size, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        self.seed_value.fill_(0 if seed is None else seed)
        # The draws depend on seed and episode, so the same seed repeats them from the start.
        self.episode_E.zero_()
