"""The updates share what is here: their dataset, its epochs of gradient steps, and what these measured."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Num
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from ksim_rl.data import DatasetBuffer, DatasetCfg, SequenceSampler
from ksim_rl.device.capture import Captured
from ksim_rl.modules import burnt_in
from ksim_rl.objectives import NonFiniteStepsError, StepGuard, ppo_step


def make_dataset(
    data: DatasetCfg,
    *,
    keys: Sequence[NestedKey],
    memories: Sequence[TensorDictModuleBase],
    seed: int,
    device: torch.device,
) -> DatasetBuffer:
    """Build the dataset of one rollout; networks with a memory learn on sequences.

    Args:
        data: sizes of dataset, minibatch and sequence.
        keys: the leaves that are kept.
        memories: of the networks that learn from it.
        seed: of the order of the env states in the minibatches.
        device: where it lives.
    """
    sampler = SequenceSampler(sequence_length=data.sequence_length, burn_in=data.burn_in, seed=seed)
    return DatasetBuffer(data, keys=keys, seed=seed, sampler=sampler if memories else None, device=device)


def epoch_of_steps(
    dataset: DatasetBuffer,
    loss: Any,
    optimizer: torch.optim.Optimizer,
    *,
    cfg: Any,
    guard: StepGuard,
    memories: Sequence[TensorDictModuleBase],
) -> list[dict[str, Num[Tensor, ""]]]:
    """Make a gradient step on each minibatch of one epoch; return what each measured, as `ppo_step` names it.

    Beside it stands `skipped_in_a_row`, the guard's count after the step.
    """
    steps = []
    for minibatch_B in dataset.epoch():
        if memories:
            minibatch_B = burnt_in(minibatch_B, *memories, steps=dataset.cfg.burn_in)
        step = ppo_step(loss, optimizer, minibatch_B, cfg=cfg, guard=guard)
        steps.append(step | {"skipped_in_a_row": guard.skipped_in_a_row.clone()})
    return steps


def in_columns(steps: Sequence[Mapping[str, Num[Tensor, ""]]]) -> dict[str, Num[Tensor, " steps"]]:
    """Return what steps measured, each quantity as a tensor [steps]."""
    return {name: torch.stack([step[name] for step in steps]) for name in steps[0]}


class StepMeans(dict[str, Tensor]):
    """Means over the gradient steps of the last update, by their logged names, each a tensor [] that stays in place.

    Args:
        names: logged names by those of what a step measures; what no step measures is left out.
    """

    def __init__(self, names: Mapping[str, str]) -> None:
        super().__init__()
        self._names = names

    def take_(self, steps: Mapping[str, Num[Tensor, " steps"]]) -> None:
        """Take the means of `steps`, each [steps], over those that were made."""
        made = steps["skipped"] == 0.0
        count = made.sum().clamp_min(1)
        for name, logged in self._names.items():
            if name in steps:
                # A skipped step is counted; its numbers would spoil the means.
                total = torch.where(made, steps[name], 0.0).sum()
                self.setdefault(logged, torch.zeros_like(total)).copy_(total / count)


class RolloutUpdate:
    """What the updates have in common: each is one piece of work on a rollout, without a host sync.

    On CUDA the first updates run eagerly and the next is captured. So each rollout must be the same memory, which is
    what `RolloutCollector` gives.

    Args:
        max_skipped_steps: so many gradient steps in a row that are not finite end the run.
        device: where all of it lives.

    Attributes:
        guard: counts gradient steps that were skipped.
    """

    def __init__(self, *, max_skipped_steps: int, device: torch.device | str) -> None:
        self.device = torch.device(device)
        self.guard = StepGuard(device=self.device)
        self._max_skipped_steps = max_skipped_steps
        self._rollout_ET: TensorDictBase | None = None
        self._longest_skip = torch.zeros((), dtype=torch.int64, device=self.device)
        self._run = Captured(self._update, device=self.device)

    def __call__(self, rollout_ET: TensorDictBase) -> None:
        """Learn from a rollout `["E","T"]` of the dataset's size."""
        self._rollout_ET = rollout_ET
        self._run()

    def check(self, metrics: Mapping[str, float]) -> None:
        """Stop a run that skips its gradient steps; `metrics` are those of `metrics()`, on the host.

        Raises:
            NonFiniteStepsError: if `max_skipped_steps` or more in a row were skipped.
        """
        # Not the guard, which knows only of those since the last step that was made.
        in_a_row, limit = int(metrics["update/skipped_in_a_row"]), self._max_skipped_steps
        if in_a_row >= limit:
            raise NonFiniteStepsError.of(in_a_row, limit=limit, skipped=int(metrics["update/skipped_steps"]))

    @property
    def rollout_ET(self) -> TensorDictBase:
        """The rollout that the update is about."""
        assert self._rollout_ET is not None
        return self._rollout_ET

    def _skipped(self) -> dict[str, Tensor]:
        """Return the metrics of the gradient steps that were not made."""
        return {"update/skipped_steps": self.guard.skipped, "update/skipped_in_a_row": self._longest_skip}

    def _update(self) -> None:
        raise NotImplementedError
