"""This module lays out for the kernels what the gradient steps of an update read of a rollout."""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int64
from tensordict import TensorDictBase
from torch import Tensor

from ksim_rl.device.memory import ROLLOUT_PARTS
from ksim_rl.objectives.algorithm_cfg import PPOCfg
from ksim_rl.objectives.fused_ppo.layout import FusedLayout, launch, parts
from ksim_rl.objectives.fused_ppo.loss_kernels import ADVANTAGE, LOG_PROB, MASK, estimate_advantages
from ksim_rl.objectives.masked import standardized
from ksim_rl.objectives.symmetry import SymmetricAugmentation

# Envs per program.
ENVS = 32
Observe = Callable[[TensorDictBase], Float[Tensor, "*batch L"]]
Evaluate = Callable[[Float[Tensor, "D L"], Float[Tensor, " D"]], None]


class FusedDataset:
    """Normalized observations, and one record for each env state, in the order of a collector's rollout: step by step.

    `obs` [2, D, L] is for actor and critic, padded with zeros, in the `dtype` of the products; `records` [D, columns]
    are described in `loss_kernels`. `observe_actor` and `observe_critic` give what the first layers take, [..., L].
    With a `mirror`, rows D to 2 D of both are the mirror images of those before.
    """

    def __init__(
        self,
        cfg: PPOCfg,
        layout: FusedLayout,
        *,
        observe_actor: Observe,
        observe_critic: Observe,
        size: int,
        dtype: torch.dtype,
        tf32: bool,
        device: torch.device,
        mirror: SymmetricAugmentation | None = None,
    ) -> None:
        self.cfg, self.layout, self.size, self._tf32, self._mirror = cfg, layout, size, tf32, mirror
        self._observe = observe_actor, observe_critic
        rows = size if mirror is None else 2 * size
        self.obs = torch.zeros(2, rows, layout.stored, dtype=dtype, device=device)
        width = layout.out
        # A standard deviation must have a logarithm, also where there is no action and where nothing takes part.
        self._neutral = torch.zeros(3 * width + 8, device=device)
        self._neutral[2 * width : 3 * width] = 1.0
        self.records = self._neutral.repeat(rows, 1)
        self._signals = torch.zeros(4, size, device=device)

    @torch.no_grad()
    def read(self, rollout_ET: TensorDictBase, *, evaluate: Evaluate) -> Int64[Tensor, ""]:
        """Take over a rollout `["E","T"]`, whose advantages are estimated here with the values that `evaluate` writes.

        An env state with an element that is not finite takes no part, as in `DatasetStorage`; returned is how many.
        """
        values_D, next_values_D, advantages_D, targets_D = self._signals
        first = 0
        for part_ET in rollout_ET.chunk(ROLLOUT_PARTS, 1):
            rows = slice(first, first + part_ET.numel())
            self._take(part_ET, self.obs[:, rows], self.records[rows])
            if self._mirror is not None:
                images = slice(self.size + rows.start, self.size + rows.stop)
                self._take(self._mirror.image(part_ET), self.obs[:, images], self.records[images])
            evaluate(self.obs[1, rows], values_D[rows])
            next_obs = self.obs.new_zeros(part_ET.numel(), self.layout.stored)
            next_obs[:, : self.layout.obs_dims[1]] = self._observed(1, part_ET.get("next"))
            evaluate(next_obs, next_values_D[rows])
            first = rows.stop
        following = rollout_ET.get("next")
        num_envs, length = rollout_ET.batch_size
        signals = {
            **dict(zip(("values", "next_values", "advantages", "targets"), self._signals, strict=True)),
            "rewards": _time_major(following.get("reward")),
            **{key: _time_major(following.get(key)) for key in ("done", "terminated")},
        }
        gamma, decay = self.cfg.gamma, self.cfg.gamma * self.cfg.lmbda
        sizes = {"num_envs": num_envs, "gamma": gamma, "decay": decay, "STEPS": length, "BLOCK": ENVS}
        launch(estimate_advantages, (parts(num_envs, ENVS),), signals, num_warps=1, **sizes)
        if self.cfg.normalize_advantage == "dataset":
            estimated_D = advantages_D.isfinite()
            normal_D = standardized(advantages_D, estimated_D, lowest_std=1e-4)
            advantages_D = torch.where(estimated_D, normal_D, torch.nan)
        return self._record(torch.stack([advantages_D, values_D, targets_D], 1))

    def _take(self, part_ET: TensorDictBase, obs_2BL: Tensor, records_B: Tensor) -> None:
        """Take over what is as the rollout has it, some steps of it."""
        width, actions = self.layout.out, self.layout.actions
        for network, dim in enumerate(self.layout.obs_dims):
            obs_2BL[network, :, :dim] = self._observed(network, part_ET)
        for place, key in enumerate(("action", "loc", "scale")):
            records_B[:, place * width : place * width + actions] = _time_major(part_ET.get(key))
        records_B[:, 3 * width + LOG_PROB.value] = _time_major(part_ET.get("action_log_prob"))

    def _observed(self, network: int, part_ET: TensorDictBase) -> Tensor:
        obs_BL = _time_major(self._observe[network](part_ET))
        return as_tf32(obs_BL) if self._tf32 else obs_BL

    def _record(self, estimates: Tensor) -> Tensor:
        first, mask = (3 * self.layout.out + column.value for column in (ADVANTAGE, MASK))
        for rows in self.records.split(self.size):
            rows[:, first:mask] = estimates
        self.records[:, mask] = 1.0
        finite_D = _finite_rows(self.records) & _finite_rows(self.obs[0]) & _finite_rows(self.obs[1])
        # A zero times NaN is NaN: what takes no part must be finite too. The mask of the neutral row is zero.
        torch.where(finite_D[:, None], self.records, self._neutral, out=self.records)
        self.obs.masked_fill_(~finite_D[None, :, None], 0.0)
        return (~finite_D[: self.size]).sum()


def as_tf32(values: Float[Tensor, "*?shape"]) -> Float[Tensor, "*?shape"]:
    """Return float32 rounded to the 11 significant bits that tensor cores read of it.

    They cut the others off, which makes each product smaller by 0.07 percent in the mean, and outputs by several times
    that: for an action with a standard deviation of a hundredth, a large change of its probability.
    """
    rounded = (values.view(torch.int32) + 0x1000 & -0x2000).view(torch.float32)
    return torch.where(values.isnan(), values, rounded)


def _time_major(leaf_ET: Tensor) -> Tensor:
    """Return `["E","T", ...]` as [T * E, ...]; a view where the memory is time-major."""
    return leaf_ET.transpose(0, 1).flatten(0, 1)


def _finite_rows(table_DL: Tensor) -> Tensor:
    """Return whether all elements of a row are finite, bool [D]: a sum is not where one of them is not."""
    # A product with ones reads the table at full speed, which a reduction of its short rows does not.
    return (table_DL @ table_DL.new_ones(table_DL.shape[1])).isfinite()
