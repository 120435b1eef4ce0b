"""The interface between trainer and algorithm, and the lookup of a run's algorithm."""

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Num
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl import ranks
from ksim_rl.data import DatasetCfg, ReplayCfg
from ksim_rl.device.state_tree import State
from ksim_rl.objectives import AlgorithmCfg
from ksim_rl.trainers.run_cfg import ModulesCfg, RunCfg

# Imported by name when an algorithm is first asked for: the algorithms stand above this room and import it.
REGISTRY = "ksim_rl.algorithms.registry"
Part = TypeVar("Part")


class Update(Protocol):
    """Improves a policy with one rollout at a time: `PPOUpdate`, one of its siblings, or a class of yours."""

    device: torch.device

    @property
    def actor(self) -> TensorDictModuleBase:
        """The policy that is evaluated, recorded and saved."""
        ...

    @property
    def behavior(self) -> TensorDictModuleBase:
        """The policy that collects; often the actor itself."""
        ...

    @property
    def num_env_states(self) -> int:
        """Env states of one rollout, E * T."""
        ...

    @property
    def rollout_keys(self) -> list[NestedKey]:
        """The leaves of an env state that an update reads."""
        ...

    def __call__(self, rollout_ET: TensorDictBase) -> None:
        """Learn from a rollout `["E","T"]`, without a host sync; on CUDA it is the same memory at each call."""

    def metrics(self) -> dict[str, Num[Tensor, ""]]:
        """Return the measurements of the last update, each a tensor [] on the device, with `update/skipped_steps`."""
        ...

    def check(self, metrics: Mapping[str, float]) -> None:
        """Raise where `metrics`, read on the host, say that the run cannot go on."""

    def state_dict(self) -> State:
        """Return everything that the next update depends on."""
        ...

    def load_state_dict(self, state: State) -> None:
        """Continue where `state_dict` was taken; tensors keep their addresses."""

    def load_weights(self, state: State) -> None:
        """Take only the networks of a `state_dict`: a new run that starts from them."""


@runtime_checkable
class HasNotes(Protocol):
    """An update with notes for the start of a run, such as why it is slower than it could be."""

    @property
    def notes(self) -> Sequence[str]: ...  # noqa: D102


@runtime_checkable
class HasWarmUp(Protocol):
    """An update that can compile and capture its work before the first env step, on a made-up rollout `["E","T"]`."""

    def warm_up(self, rollout_ET: TensorDictBase) -> None: ...  # noqa: D102


@runtime_checkable
class FollowsEpisodes(Protocol):
    """An update that keeps env states of earlier rollouts, and is told where all envs were reset between two."""

    def restarted(self) -> None: ...  # noqa: D102


@runtime_checkable
class HasProgress(Protocol):
    """An update that depends on the share of the run, in [0, 1], that is done, such as by its learning rate."""

    def set_progress(self, done: float) -> None: ...  # noqa: D102


def notes_of(update: Update, *, warm_up: bool) -> list[str]:
    """Return the notes about an update for the start of a run, one line each."""
    lacks = f"trainer.warm_up=true does nothing here: {type(update).__name__} has no warm_up(rollout_ET)"
    if isinstance(update, HasNotes):
        own = update.notes
    else:
        own = ()
    if warm_up and not isinstance(update, HasWarmUp):
        return [*own, lacks]
    return [*own]


@dataclass(frozen=True, kw_only=True)
class Algorithm:
    """How the parts of an algorithm are made for a run and its env, and which data and networks suit it.

    A module of a registered package that holds one at its top level registers it. The third argument of `update` is the
    `state_dict` of the update that a resumed run goes on from, for parts that are made from it; the trainer loads it
    afterwards. None begins from scratch.
    """

    name: str  # as in `objective=<name>`
    # A run whose objective is one of these, or of a subclass, is trained by it.
    cfg: type[AlgorithmCfg]
    update: Callable[[RunCfg, EnvBase, State | None], Update]
    # Its weights: `update/actor` of a checkpoint.
    policy: Callable[[RunCfg, EnvBase], TensorDictModuleBase]
    # Chosen by `objective=<name>` along with its settings, as are the modules.
    data: DatasetCfg | ReplayCfg
    modules: ModulesCfg = field(default_factory=ModulesCfg)
    on_ranks: bool = False  # whether several ranks may train with it


def part_of(cfg: RunCfg, field: str, kind: type[Part]) -> Part:
    """Return a part of a config by its dotted path; a ValueError if it is not a `kind`."""
    value = attrgetter(field)(cfg)
    if not isinstance(value, kind):
        raise ValueError(
            f"{field} is a {type(value).__name__}, and {type(cfg.objective).__name__} needs a {kind.__name__}: "
            "objective=... on the command line chooses the parts that fit"
        )
    return value


def algorithm_of(cfg: RunCfg) -> Algorithm:
    """Return the algorithm of a run; a ValueError where none is registered for its objective."""
    # By name, as the registry imports this module.
    return importlib.import_module(REGISTRY).serving(type(cfg.objective))


def make_update(cfg: RunCfg, env: EnvBase, *, resumed: State | None = None) -> Update:
    """Build everything that learns in a run, with all its memory allocated; see `Algorithm.update`."""
    algorithm = algorithm_of(cfg)
    # Without means over ranks each would train a different policy, unnoticed.
    if ranks.size() > 1 and not algorithm.on_ranks:
        raise ValueError(
            f"objective={algorithm.name} trains on one rank only: start it without torchrun"
        )
    return algorithm.update(cfg, env, resumed)


def make_policy(cfg: RunCfg, env: EnvBase) -> TensorDictModuleBase:
    """Build the policy of a run, and nothing else of it."""
    return algorithm_of(cfg).policy(cfg, env)
