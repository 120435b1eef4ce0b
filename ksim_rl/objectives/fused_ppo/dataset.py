"""This module lays out for the kernels what the gradient steps of an update read of a rollout."""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int64
from tensordict import TensorDictBase
from torch import Tensor

from ksim_rl.objectives.algorithm_cfg import PPOCfg
from ksim_rl.objectives.fused_ppo.layout import FusedLayout, launch, parts
from ksim_rl.objectives.fused_ppo.loss_kernels import LOG_PROB, MASK, estimate_advantages
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
        device: torch.device,
        mirror: SymmetricAugmentation | None = None,
    ) -> None:
        self.cfg, self.layout, self.size, self._mirror = cfg, layout, size, mirror
        self._observe = observe_actor, observe_critic
        rows = size if mirror is None else 2 * size
        self.obs = torch.zeros(2, rows, layout.obs, dtype=dtype, device=device)
        self._next_obs = torch.zeros(size, layout.obs, dtype=dtype, device=device)
        width = layout.out
        # A standard deviation must have a logarithm, also where there is no action and where nothing takes part.
        self._neutral = torch.zeros(3 * width + 16, device=device)
        self._neutral[2 * width : 3 * width] = 1.0
        self.records = self._neutral.repeat(rows, 1)
        self._signals = torch.zeros(4, size, device=device)

    @torch.no_grad()
    def read(self, rollout_ET: TensorDictBase, *, evaluate: Evaluate) -> Int64[Tensor, ""]:
        """Take over a rollout `["E","T"]`, whose advantages are estimated here with the values that `evaluate` writes.

        An env state with an element that is not finite takes no part, as in `DatasetStorage`; returned is how many.
        """
        following = rollout_ET.get("next")
        halves = [rollout_ET] if self._mirror is None else [rollout_ET, self._mirror.image(rollout_ET)]
        for obs_DL, observe, dim in zip(self.obs, self._observe, self.layout.obs_dims, strict=True):
            for rows_DL, half_ET in zip(obs_DL.split(self.size), halves, strict=True):
                rows_DL[:, :dim] = _time_major(observe(half_ET))
        self._next_obs[:, : self.layout.obs_dims[1]] = _time_major(self._observe[1](following))
        values_D, next_values_D, advantages_D, targets_D = self._signals
        evaluate(self.obs[1, : self.size], values_D)
        evaluate(self._next_obs, next_values_D)
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
        return self._record(halves, torch.stack([advantages_D, values_D, targets_D], 1))

    def _record(self, halves: list[TensorDictBase], estimates: Tensor) -> Tensor:
        width, actions = self.layout.out, self.layout.actions
        first, mask = 3 * width + LOG_PROB.value, 3 * width + MASK.value
        for rows, half_ET in zip(self.records.split(self.size), halves, strict=True):
            for place, key in enumerate(("action", "loc", "scale")):
                rows[:, place * width : place * width + actions] = _time_major(half_ET.get(key))
            rows[:, first] = _time_major(half_ET.get("action_log_prob"))
            rows[:, first + 1 : mask] = estimates
            rows[:, mask] = 1.0
        finite_D = _finite_rows(self.records) & _finite_rows(self.obs[0]) & _finite_rows(self.obs[1])
        # A zero times NaN is NaN: what takes no part must be finite too. The mask of the neutral row is zero.
        torch.where(finite_D[:, None], self.records, self._neutral, out=self.records)
        self.obs.masked_fill_(~finite_D[None, :, None], 0.0)
        return (~finite_D[: self.size]).sum()


def _time_major(leaf_ET: Tensor) -> Tensor:
    """Return `["E","T", ...]` as [T * E, ...]; a view where the memory is time-major."""
    return leaf_ET.transpose(0, 1).flatten(0, 1)


def _finite_rows(table_DL: Tensor) -> Tensor:
    """Return whether all elements of a row are finite, bool [D]: a sum is not where one of them is not."""
    # A product with ones reads the table at full speed, which a reduction of its short rows does not.
    return (table_DL @ table_DL.new_ones(table_DL.shape[1])).isfinite()
