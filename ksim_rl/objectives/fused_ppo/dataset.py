"""Lays out a rollout in memory for the kernels of the gradient steps."""

from collections.abc import Callable, Iterator
from functools import reduce
from operator import add

import torch
from jaxtyping import Float, Int32
from tensordict import TensorDictBase
from torch import Tensor

from ksim_rl import ranks
from ksim_rl.device.memory import ROLLOUT_PARTS
from ksim_rl.objectives.algorithm_cfg import PPOCfg
from ksim_rl.objectives.fused_ppo.dataset_kernels import read_observations, write_records
from ksim_rl.objectives.fused_ppo.layout import (
    Argument,
    FusedLayout,
    FusedNetworks,
    launch,
    parts,
    power_of_two,
)
from ksim_rl.objectives.fused_ppo.loss_kernels import estimate_advantages
from ksim_rl.objectives.symmetry import SymmetricAugmentation

# Envs per program.
ENVS = 32


class FusedDataset:
    """Normalized observations, and one record for each env state, in the order of a collector's rollout: step by step.

    `obs` [2, D, L] is for actor and critic, padded with zeros, in the `dtype` of the products; `records` [D, columns]
    are described in `loss_kernels`. With a `mirror`, rows D to 2 D of both are the mirror images of those before.
    """

    def __init__(
        self,
        cfg: PPOCfg,
        layout: FusedLayout,
        *,
        networks: FusedNetworks,
        size: int,
        dtype: torch.dtype,
        tf32: bool,
        device: torch.device,
        mirror: SymmetricAugmentation | None = None,
    ) -> None:
        self.layout = layout
        self.size = size
        self._mirror = mirror
        self._networks = networks
        # Images take the second half of the rows.
        rows = size if mirror is None else 2 * size
        self.obs = torch.zeros(2, rows, layout.stored, dtype=dtype, device=device)
        self.records = torch.zeros(rows, 3 * layout.out + 8, device=device)
        self._signals = torch.zeros(4, size, device=device)
        # Which env states take no part, of the actor and the critic; and how many next observations are listed.
        self._faults = torch.zeros(2, rows, dtype=torch.int8, device=device)
        self._count = torch.zeros(1, dtype=torch.int32, device=device)
        places = torch.zeros(size, dtype=torch.int32, device=device)
        # Powers of two, over the columns of an observation and of a record.
        self._lanes = power_of_two(layout.stored)
        self._record_lanes = power_of_two(self.records.shape[1])
        # The arguments of kernels, by the names of their parameters.
        self._arguments: dict[str, Argument] = {
            **dict(
                zip(("values", "next_values", "advantages", "targets"), self._signals, strict=True)
            ),
            **{name.upper(): getattr(layout, name) for name in ("actions", "out", "stored")},
            "obs": self.obs,
            "records": self.records,
            "num_obs": rows,
            "size": size,
            "faults": self._faults,
            "known": self.obs[1],
            "places": places,
            "count": self._count,
            "gamma": cfg.gamma,
            "decay": cfg.gamma * cfg.lmbda,
            "min_advantage_std": cfg.min_advantage_std,
            "LANES": self._lanes,
            "RECORD": self.records.shape[1],
            "RECORD_LANES": self._record_lanes,
            "TF32": tf32,
            "STANDARDIZED": cfg.normalize_advantage == "dataset",
        }
        self.listed: dict[str, Tensor] = {}
        if layout.chained:
            self.listed = {"places": places, "count": self._count}

    @torch.no_grad()
    def read(
        self, rollout_ET: TensorDictBase, *, evaluate: Callable[..., None]
    ) -> Int32[Tensor, ""]:
        """Take over a rollout `["E","T"]`, whose advantages are estimated here with the values that `evaluate` writes.

        An env state with an element that is not finite takes no part, as in `DatasetStorage`; returned is how many.
        """
        # First the observations, which are normalized by the statistics that the rollout was collected with.
        for part_ET, first in self._parts(rollout_ET):
            for network, faults_D in enumerate(self._faults):
                self._take_observations(
                    network, part_ET, self.obs[network, first:], faults=faults_D[first:]
                )
        following = rollout_ET.get("next")
        num_envs, length = rollout_ET.batch_size
        # Values of all env states, and of the next observations that differ from the following step's.
        next_obs = torch.empty_like(self.obs[1, : self.size])
        evaluate(self.obs[1, : self.size], self._signals[0])
        self._count.zero_()
        self._take_observations(1, following, next_obs, num_envs=num_envs, LISTED=bool(self.listed))
        evaluate(next_obs, self._signals[1], **self.listed)
        programs = parts(num_envs, ENVS)
        # Each program leaves the moments of its advantages, which standardize the advantages of all ranks.
        moments = self.records.new_empty(programs, 3)
        signals = {key: _time_major(following.get(key)) for key in ("reward", "done", "terminated")}
        sizes = {"num_envs": num_envs, "STEPS": length, "BLOCK": ENVS}
        given = self._arguments | signals | sizes
        launch(estimate_advantages, (programs,), given, num_warps=1, moments=moments)
        moments = torch.cat(ranks.gather(moments))
        # Last the records: standardized advantages need the moments of all parts.
        left_out = [
            self._take_records(part_ET, first, moments)
            for part_ET, first in self._parts(rollout_ET)
        ]
        return reduce(add, (own.sum(dtype=torch.int32) for own in left_out))

    def _parts(self, rollout_ET: TensorDictBase) -> Iterator[tuple[TensorDictBase, int]]:
        """Yield the rollout, or some steps at a time and their mirror images, and at which row each begins."""
        first = 0
        for part_ET in [rollout_ET] if self._mirror is None else rollout_ET.chunk(ROLLOUT_PARTS, 1):
            yield part_ET, first
            if self._mirror is not None:
                yield self._mirror.image(part_ET), self.size + first
            first += part_ET.numel()

    def _take_records(self, part_ET: TensorDictBase, first: int, moments: Tensor) -> Tensor:
        """Write records, and return of each program how many env states it left out."""
        rows = part_ET.numel()
        block = _block(self._record_lanes)
        left_out = torch.empty(parts(rows, block), dtype=torch.int32, device=self.records.device)
        own = {
            "obs": self.obs[0, first:],
            "records": self.records[first:],
            "first": first,
            "num_rows": rows,
        }
        own |= {
            "moments": moments,
            "num_moments": len(moments),
            "left_out": left_out,
            "BLOCK": block,
        }
        keys = ("action", "loc", "scale", "action_log_prob")
        acted = {key: _time_major(part_ET.get(key)) for key in keys}
        # Kernels know the gaussian before the tanh only, so that stored actions are taken back through it.
        if self._networks.squashed is not None:
            policy = self._networks.squashed(acted["loc"], acted["scale"])
            acted["action"] = action = policy.latent(acted["action"])
            acted["action_log_prob"] = policy.base.log_prob(action)
        given = self._arguments | acted | own
        launch(write_records, (len(left_out),), given, MOMENTS=power_of_two(len(moments)))
        return left_out

    def _take_observations(
        self, network: int, part_ET: TensorDictBase, obs: Tensor, **changes: Argument
    ) -> None:
        observer = self._networks.observers[network]
        # Inputs of the network side by side, in the order of the rows of `obs`.
        source = _time_major(observer.read(part_ET))
        block = _block(self._lanes)
        own = {
            "source": source,
            "obs": obs,
            "num_rows": len(source),
            "WIDTH": source.shape[1],
            "num_envs": 0,
        }
        given = (
            self._arguments
            | observer.moments_given
            | own
            | {"LISTED": False, "faults": None}
            | changes
        )
        launch(read_observations, (parts(len(source), block),), given, BLOCK=block)


def as_tf32(values: Float[Tensor, "*?shape"]) -> Float[Tensor, "*?shape"]:
    """Return float32 rounded to the 11 significant bits that tensor cores read of it.

    They cut the others off, which makes each product smaller by 0.07 percent in the mean, and outputs by several times
    that: for an action with a standard deviation of a hundredth, a large change of its probability.
    """
    # Half of the bits that are cut off is added first, which rounds to the nearest.
    rounded = (values.view(torch.int32) + 0x1000 & -0x2000).view(torch.float32)
    return torch.where(values.isnan(), values, rounded)


def _time_major(leaf_ET: Tensor) -> Tensor:
    """Return `["E","T", ...]` as [T * E, ...] in one piece; a view where the memory is time-major."""
    return leaf_ET.transpose(0, 1).flatten(0, 1).contiguous()


def _block(lanes: int) -> int:
    """Return how many rows of so many lanes a program takes: 32 elements a thread."""
    return max(4096 // lanes, 1)
