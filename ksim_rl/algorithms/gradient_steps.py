"""The parts that updates share: datasets, gradient steps, the means of their measurements, and checkpoints."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import torch
from jaxtyping import Num
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from ksim_rl.compiled.python_states import PLAIN
from ksim_rl.compiled.python_values import Listed, Part
from ksim_rl.compiled.watched_graphs import WatchedGraphs
from ksim_rl.data import DatasetBuffer, DatasetCfg, SequenceSampler
from ksim_rl.device import state_tree
from ksim_rl.device.capture import Captured
from ksim_rl.device.state_tree import State, branch
from ksim_rl.envs.signal_keys import STANDARD, SignalKeys
from ksim_rl.modules import burnt_in, recurrent_modules
from ksim_rl.objectives import (
    NonFiniteStepsError,
    StepGuard,
    anneal_learning_rate_,
    make_optimizer,
    ppo_step,
)


def in_columns(steps: Sequence[Mapping[str, Num[Tensor, ""]]]) -> dict[str, Num[Tensor, " steps"]]:
    """Return the measurements of steps, each quantity as a tensor [steps]."""
    columns = {}
    for name in steps[0]:
        measured = [step[name].detach() for step in steps]
        columns[name] = torch.stack(measured)
    return columns


def public_objects(owner: Part) -> dict[str, Part]:
    """Return the attributes of an object that are no numbers or texts, and that its name does not keep private."""
    named = vars(owner).items()
    return {name: value for name, value in named if name[0] != "_" and not isinstance(value, PLAIN)}


class StepMeans(dict[str, Tensor]):
    """Means over the steps of the last update, tensors [] that stay in place; `names` has logged names by measured."""

    def __init__(self, names: Mapping[str, str]) -> None:
        super().__init__()
        self._names = names

    def take_(self, steps: Mapping[str, Num[Tensor, " steps"]]) -> None:
        """Take the means of `steps`, each [steps], over those that were made."""
        made = steps["skipped"] == 0.0
        logged = {name: own for name, own in self._names.items() if name in steps}
        # A skipped step is counted; its numbers would spoil the means.
        # A where instead of a product: a skipped step may have measured NaN.
        totals = torch.where(made, torch.stack([steps[name] for name in logged]), 0.0).sum(1)
        means = (totals / made.sum().clamp_min(1)).unbind()
        for own in (own for own in logged.values() if own not in self):
            self[own] = torch.zeros_like(means[0])
        # In place, as a captured graph writes to the same tensors each time.
        torch._foreach_copy_([self[own] for own in logged.values()], means)


class RolloutUpdate(ABC):
    """The base of all updates: each is one piece of work on a rollout, without a host sync.

    On CUDA the first updates run eagerly and the next is captured. So each rollout must be the same memory, as
    `RolloutCollector` gives it. Where a program changes an attribute of a loss, a network or an optimizer from
    outside, the next one is captured again. The `networks` are all that learn, by the names that a checkpoint gives
    them; so many as `max_skipped_steps` in a row that are not finite, which `guard` counts, end the run. The env's own
    keys of reward and flags are `signals`; see `signal_keys`. The `logged` are names of logged means, by the names that
    steps measure.
    """

    def __init__(
        self,
        networks: Mapping[str, nn.Module],
        *,
        max_skipped_steps: int,
        logged: Mapping[str, str],
        device: torch.device | str = "cpu",
        signals: SignalKeys = STANDARD,
    ) -> None:
        self.device = torch.device(device)
        self.networks = networks
        self.signals = signals
        self.guard = StepGuard(device=self.device)
        self._means = StepMeans(logged)
        self._max_skipped_steps = max_skipped_steps
        self._rollout_ET: TensorDictBase | None = None
        # The guard's own count is of the last step only; an update may have had a longer row of skips.
        self._longest_skip = torch.zeros((), dtype=torch.int64, device=self.device)
        # `_update` is all of the work, so that on CUDA it becomes one graph.
        self._run = Captured(self._update, device=self.device)
        self._work = [self._run]  # all that is captured
        # Plain numbers of an update are its counters, which change with each call.
        parts = {"update": Listed(self, partial(public_objects, self))}
        self._watched = WatchedGraphs(self._work, parts, self.device)

    def __call__(self, rollout_ET: TensorDictBase) -> None:
        """Learn from a rollout `["E","T"]` of the dataset's size."""
        self._rollout_ET = rollout_ET
        with self._watched.watched():
            self._run()

    def warm_up(self, rollout_ET: TensorDictBase) -> None:
        """Compile and capture the work of updates, on a made-up rollout, which leaves no trace.

        Networks, optimizers, data and counters are afterwards as before, and draws did not count. On CUDA the
        rollout must be in the memory of those that follow, whose updates then replay graphs from the first.
        """
        # A copy of everything that the work below changes.
        kept = state_tree.join(*state_tree.split(self.state_dict()))
        self._rollout_ET = rollout_ET
        if self.device.type == "cuda":
            devices = [self.device]
        else:
            devices = []
        # Draws of the warm-up must not move the generators of the run.
        with torch.random.fork_rng(devices), self._watched.watched():
            for work in self._work:
                # The runs before a capture, and the one that captures.
                for _ in range(work.warmup + 1):
                    work()
        self.load_state_dict(kept)
        # Means are no part of the state, and would show the numbers of the made-up rollout.
        for tensor in (*self._means.values(), self._longest_skip):
            tensor.zero_()

    def check(self, metrics: Mapping[str, float]) -> None:
        """Raise NonFiniteStepsError where `metrics()`, on the host, say that too many steps in a row were skipped."""
        # Not the guard, which knows only of those since the last step that was made.
        in_a_row = int(metrics["update/skipped_in_a_row"])
        limit = self._max_skipped_steps
        if in_a_row >= limit:
            raise NonFiniteStepsError(
                in_a_row, limit=limit, skipped=int(metrics["update/skipped_steps"])
            )

    @property
    def rollout_ET(self) -> TensorDictBase:
        """The rollout that the update is about, with its signals under TorchRL's names."""
        assert self._rollout_ET is not None
        return self.signals.renamed(self._rollout_ET)

    def metrics(self) -> dict[str, Num[Tensor, ""]]:
        """Return the measurements of the last update, each a tensor [] on the device; means are over the steps made."""
        skipped = {
            "update/skipped_steps": self.guard.skipped,
            "update/skipped_in_a_row": self._longest_skip,
        }
        return {**self._means, **skipped}

    @abstractmethod
    def _update(self) -> None:
        """Learn from `rollout_ET`."""

    def _measure_(self, steps: Mapping[str, Tensor]) -> None:
        self._means.take_(steps)
        self._longest_skip.copy_(steps["skipped_in_a_row"].max())

    def state_dict(self) -> state_tree.State:
        """Return everything that the next update depends on."""
        networks = {name: network.state_dict() for name, network in self.networks.items()}
        return {**networks, "guard": self.guard.state_dict()}

    def load_state_dict(self, state: State) -> None:
        """Continue where `state_dict` was taken, at the same addresses; a ValueError names what does not fit."""
        self.load_weights(state)
        state_tree.copy_into(self.guard.state_dict(), branch(state, "guard"), what="guard")

    def load_weights(self, state: State) -> None:
        """Take only the networks of a `state_dict`; a ValueError names the tensor that does not fit."""
        for name, network in self.networks.items():
            saved = branch(state, name)
            state_tree.copy_into(network.state_dict(), saved, what=name.replace("_", " "))


class DatasetUpdate(RolloutUpdate):
    """The base of updates that make epochs of gradient steps on the dataset of each rollout.

    The loss says which leaves the dataset keeps; recurrent networks learn on sequences. The `seed` is of the order of
    the env states in the minibatches; `shared` are the other arguments of `RolloutUpdate`.
    """

    def __init__(
        self,
        cfg: Any,
        *,
        loss: Any,
        networks: Mapping[str, TensorDictModuleBase],
        data: DatasetCfg,
        seed: int = 0,
        **shared: Any,
    ) -> None:
        super().__init__(networks, max_skipped_steps=cfg.max_skipped_steps, **shared)
        self.cfg = cfg
        self.loss = loss
        self.num_env_states = data.num_env_states
        # One optimizer for all networks, so that their gradients are clipped by one norm.
        self.optimizer = make_optimizer(cfg, *networks.values())
        self._recurrent = recurrent_modules(*networks.values())
        sampler = None
        # Recurrent networks need steps in order: minibatches are then whole sequences.
        if self._recurrent:
            sizes = ("sequence_length", "burn_in", "shards", "num_minibatches")
            sampler = SequenceSampler(seed=seed, **{name: getattr(data, name) for name in sizes})
        self.dataset = DatasetBuffer(
            data, keys=loss.dataset_keys, seed=seed, sampler=sampler, device=self.device
        )

    def set_progress(self, done: float) -> None:
        """Set the share of the run that is done before the next update; a learning rate that is annealed follows it."""
        anneal_learning_rate_(self.cfg, self.optimizer, done=done)

    def metrics(self) -> dict[str, Num[Tensor, ""]]:
        """Return the measurements of the last update; see `RolloutUpdate`."""
        return super().metrics() | {
            "update/learning_rate": self.optimizer.param_groups[0]["lr"],
            "update/non_finite_env_states": self.dataset.non_finite_count,
        }

    def _epoch(self, loss: Any) -> list[dict[str, Tensor]]:
        """Make a gradient step on each minibatch of an epoch; return their measurements, with `skipped_in_a_row`."""
        steps = []
        for minibatch_B in self.dataset.epoch():
            # States are renewed by the present networks, as stored ones are of older weights.
            if self._recurrent:
                minibatch_B = burnt_in(
                    minibatch_B, *self._recurrent, steps=self.dataset.cfg.burn_in
                )
            step = ppo_step(loss, self.optimizer, minibatch_B, cfg=self.cfg, guard=self.guard)
            # A copy: the guard counts in place.
            steps.append(step | {"skipped_in_a_row": self.guard.skipped_in_a_row.clone()})
        return steps

    def state_dict(self) -> state_tree.State:
        """Return networks, optimizer, sampler and counters."""
        return {
            **super().state_dict(),
            "optimizer": optimizer_state(self.optimizer),
            "sampler": self.dataset.sampler.state_dict(),
            "non_finite_env_states": self.dataset.non_finite_count,
        }

    def load_state_dict(self, state: State) -> None:
        """Continue where `state_dict` was taken; see `RolloutUpdate`."""
        super().load_state_dict(state)
        load_optimizer_state(self.optimizer, branch(state, "optimizer"), what="optimizer")
        self.dataset.sampler.load_state_dict(dict(branch(state, "sampler")))
        self.dataset.non_finite_count.copy_(state_tree.tensor(state, "non_finite_env_states"))


def optimizer_state(optimizer: torch.optim.Optimizer) -> state_tree.State:
    """Return learning rates and moments; a parameter that no loss has reached has an empty entry."""
    group = optimizer.param_groups[0]
    moments: dict[str, State] = {}
    for index, own in enumerate(group["params"]):
        moments[str(index)] = dict(optimizer.state.get(own, {}))
    return {
        "learning_rate": group["lr"],
        "initial_learning_rate": group.get("initial_lr"),
        "moments": moments,
    }


def load_optimizer_state(optimizer: torch.optim.Optimizer, state: State, *, what: str) -> None:
    """Continue where `optimizer_state` was taken, at the same addresses; a ValueError names what does not fit."""
    group = optimizer.param_groups[0]
    parameters = optimizer.param_groups[0]["params"]
    saved = branch(state, "moments")
    moments = {int(index): state_tree.tensors(branch(saved, index)) for index in saved}
    # All checks before the first copy, so that a refused state leaves the optimizer as it was.
    if set(moments) != set(range(len(parameters))):
        raise ValueError(
            f"{what}: {len(moments)} parameters in the checkpoint, {len(parameters)} in this run"
        )
    for index, parameter in enumerate(parameters):
        for name in ("exp_avg", "exp_avg_sq") if moments[index] else ():
            if moments[index][name].shape != parameter.shape:
                raise ValueError(
                    f"{what}: {name} of parameter {index} has shape {list(moments[index][name].shape)} in the "
                    f"checkpoint and {list(parameter.shape)} in this run"
                )
    # Or else it is given again.
    if state.get("initial_learning_rate") in (None, group.get("initial_lr")):
        group["lr"].copy_(torch.as_tensor(state["learning_rate"]))
    for index, parameter in enumerate(parameters):
        # In place where there are moments, whose addresses a captured graph holds.
        own = optimizer.state[parameter]
        for name, tensor in moments[index].items():
            own.setdefault(name, torch.empty_like(tensor, device=parameter.device)).copy_(tensor)
        # Moments begin as zeros. Those that are there may belong to a graph.
        for name in own.keys() - moments[index].keys():
            own[name].zero_()
