"""Random commands that get harder for envs that follow them come from the transform of this module."""

from collections.abc import Sequence

import torch
from jaxtyping import Num
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite

from ksim_rl import checks
from ksim_rl.device import random
from ksim_rl.transforms.row_transform import KeyedTransform, Keys, as_keys, by_level, moved_level
from ksim_rl.transforms.specs import bounded, leaf_spec, set_leaf_spec

Ranges = Sequence[tuple[float, float]]


class RandomCommandCurriculum(KeyedTransform):
    """A random command per env, float32 [E, K], from ranges that widen with the level of the env, [E, 1].

    At the end of an episode the level of its env rises by `step` if the mean of the score (the in key, a reward or
    observation) over the episode's steps exceeds `raise_above`, and falls by it below `lower_below`, within [0, 1].
    `set_level_` drives it from outside instead, without in keys. Out keys are those of command and level. `start` and
    `end` are (low, high) per column of the command at level 0 and 1, linear in between. Within an episode a command is
    drawn anew after `resample_every` env steps; 0 keeps it.

    Example:
        >>> commands = RandomCommandCurriculum(start=[(0.0, 0.5)], end=[(-1.0, 2.0)], raise_above=0.8)
    """

    purposes = ("reset/command", "step/command")

    level_E: Tensor
    score_E: Tensor
    age_E: Tensor
    command_EL: Tensor
    ends_22L: Tensor

    def __init__(
        self,
        in_keys: Keys = "reward",
        out_keys: Sequence[NestedKey] = ("command", "command_level"),
        *,
        start: Ranges,
        end: Ranges,
        raise_above: float | None = None,
        lower_below: float | None = None,
        step: float = 0.1,
        initial_level: float = 0.0,
        resample_every: int = 0,
        seed: int | None = None,
        stream: str | None = None,
    ) -> None:
        keys, outs = as_keys(in_keys), as_keys(list(out_keys))
        if len(keys) > 1 or len(outs) != 2 or outs[0] == outs[1]:
            raise ValueError(
                f"in_keys={keys}, out_keys={outs}: expected at most one in key and two distinct out keys"
            )
        if not keys and (raise_above is not None or lower_below is not None):
            raise ValueError("raise_above and lower_below need a score: give in_keys")
        if len(start) != len(end) or not start:
            raise ValueError(f"start has {len(start)} ranges and end {len(end)}: give one per column in each")
        for name, ranges in (("start", start), ("end", end)):
            for index, pair in enumerate(ranges):
                checks.check_pair(f"{name}[{index}]", pair)
        for name, value in (("raise_above", raise_above), ("lower_below", lower_below)):
            if value is not None:
                checks.check_in_range(name, value)
        if raise_above is not None and lower_below is not None and lower_below > raise_above:
            raise ValueError(f"lower_below={lower_below} exceeds raise_above={raise_above}")
        checks.check_in_range("step", step, low=0.0, high=1.0, low_open=True)
        checks.check_in_range("initial_level", initial_level, low=0.0, high=1.0)
        checks.check_count("resample_every", resample_every, low=0)
        super().__init__(keys, outs, is_paired=False, seed=seed, stream=stream)
        self._register_rows("level_E", "score_E", "age_E", "command_EL")
        self.raise_above, self.lower_below, self.step = raise_above, lower_below, step
        self.initial_level, self.resample_every = initial_level, resample_every
        ends = [[[pair[side] for pair in ranges] for side in (0, 1)] for ranges in (start, end)]
        self.register_buffer("ends_22L", torch.tensor(ends, dtype=torch.float32), persistent=False)

    def set_level_(self, level: float | Num[Tensor, "*rows"]) -> None:
        """Set the level of all envs, or of each, [E]; commands follow at their next draw."""
        if self._buffers["level_E"] is None:
            raise RuntimeError("levels are there once an env holds the transform and has made its specs")
        if not isinstance(level, Tensor):
            checks.check_in_range("level", level, low=0.0, high=1.0)
            self.level_E.fill_(level)
        else:
            self.level_E.copy_(level.clamp(0.0, 1.0))

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        output_spec = output_spec.clone()
        observations = output_spec["full_observation_spec"]
        for key in self.in_keys:
            if key not in observations.keys(True, True):
                leaf_spec(output_spec["full_reward_spec"], key, type(self).__name__)
        batch, device = observations.shape, observations.device
        low_L, high_L = self.ends_22L[:, 0].amin(0).to(device), self.ends_22L[:, 1].amax(0).to(device)
        ends = [end.expand(*batch, -1) for end in (low_L, high_L)]
        set_leaf_spec(observations, self.out_keys[0], bounded(*ends, dtype=torch.float32, device=device))
        level = Bounded(0.0, 1.0, torch.Size([*batch, 1]), dtype=torch.float32, device=device)
        set_leaf_spec(observations, self.out_keys[1], level)
        self._size_rows(observations)
        if self._buffers["level_E"] is None:
            self._buffers["level_E"] = torch.full((self.num_rows,), float(self.initial_level), device=device)
        self._size_buffer("score_E", torch.float32)
        self._size_buffer("age_E", torch.int64)
        self._size_buffer("command_EL", torch.float32, self.ends_22L.shape[-1:])
        return output_spec

    def _begin(self, tensordict_reset: TensorDictBase, mask_E: Tensor) -> TensorDictBase:
        mean_E = self.score_E / self.age_E.clamp_min(1)
        moved_E = moved_level(self.level_E, mean_E, self.step, self.raise_above, self.lower_below)
        self.level_E.copy_(torch.where(mask_E & (self.age_E > 0), moved_E, self.level_E))
        self.score_E.masked_fill_(mask_E, 0.0)
        self.age_E.masked_fill_(mask_E, 0)
        self._draw(self._reset_keys("reset/command"), mask_E)
        return self._write(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._sized()
        self.step_count.add_(1)
        self.age_E.add_(1)
        for key in self.in_keys:
            self.score_E.add_(next_tensordict.get(key).reshape(self.num_rows, -1).float().mean(-1))
        if self.resample_every:
            self._draw(self._step_keys("step/command"), self.age_E % self.resample_every == 0)
        return self._write(next_tensordict)

    def _draw(self, keys: random.RowKeys, mask_E: Tensor) -> None:
        low_EL, high_EL = by_level(
            self.ends_22L[0, :, None], self.ends_22L[1, :, None], self.level_E[:, None]
        )
        drawn_EL = random.uniform(keys, low_EL.shape[1], low_EL, high_EL)
        self.command_EL.copy_(torch.where(mask_E[:, None], drawn_EL, self.command_EL))

    def _write(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Give out copies: the kept ones change in place."""
        batch = tensordict.batch_size
        tensordict.set(self.out_keys[0], self.command_EL.clone().reshape(*batch, -1))
        return tensordict.set(self.out_keys[1], self.level_E.clone().reshape(*batch, 1))
