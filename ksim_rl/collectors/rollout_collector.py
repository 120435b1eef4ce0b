"""This module collects rollouts of fixed length from all envs, as one CUDA graph where there is CUDA."""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from jaxtyping import Shaped
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ksim_rl import dims
from ksim_rl.checked import Checked, Count
from ksim_rl.checks import check_count
from ksim_rl.compiled.compiled_step import CompiledStep
from ksim_rl.device.capture import Captured
from ksim_rl.device.copying import copy_rows
from ksim_rl.device.state_tree import copy_into
from ksim_rl.envs.contract import EpisodeClock, SimulatedWorld, part
from ksim_rl.envs.masked_reset import MaskedReset
from ksim_rl.transforms.specs import spell


@dataclass(frozen=True, kw_only=True)
class CollectorCfg(Checked):
    """Options of `RolloutCollector` that a config may set.

    `require_graphs` fails where CUDA graphs are unavailable, instead of running slower with a warning.
    `compile` makes few kernels of what terms and transforms compute, which is checked once against the env's own steps:
    rollouts take less time, and are those of the env to rounding. None does so for envs with a `SimulatedWorld`.
    `stagger_episodes` spreads the time-outs of the envs over an episode's length at the first reset, where the env
    offers it. The first `warmup` rollouts on CUDA run eagerly. In the config of a run, `rollout_length` may be given
    instead of the dataset's size, which then follows from it and the number of envs.
    """

    require_graphs: bool = False
    compile: bool | None = None
    stagger_episodes: bool = False
    warmup: Count = 2
    rollout_length: Count | None = None


_exploring = partial(set_exploration_type, ExplorationType.RANDOM)
Policy = Callable[[TensorDictBase], TensorDictBase]


class RolloutCollector:
    """Runs `policy` in `env` for T steps at a time; envs that end are reset within the rollout.

    On CUDA the T steps of policy, physics, terms, transforms and resets are one graph: the first rollouts run eagerly
    (they warm the kernels up and are as good as any), the next is captured, and from then on each is one launch. On CPU
    each control step's physics is one Warp graph and torch stays eager.

    The rollout is the same as that of `EnvBase.rollout(T, policy, break_when_any_done=False, auto_reset=False)`. On
    CUDA the env's `step_and_maybe_reset` must not synchronize (`ManagerBasedRlEnv`, `MaskedTransformedEnv`); on CPU any
    TorchRL env of batch size [E] will do. The policy writes the action, and what training needs; one that has a context
    `steady()` acts within it, where its weights stay. Stored are the leaves at `keys`, None for all: fewer cost fewer
    bytes and less time.
    """

    def __init__(
        self,
        env: EnvBase,
        policy: Policy,
        *,
        rollout_length: int,
        keys: Sequence[NestedKey] | None = None,
        cfg: CollectorCfg | None = None,
    ) -> None:
        check_count("rollout_length", rollout_length)
        if len(env.batch_size) != 1:
            raise ValueError(f"env.batch_size={tuple(env.batch_size)}: expected one dim, [E]")
        cfg = cfg or CollectorCfg()
        self._clock = part(env, EpisodeClock) if cfg.stagger_episodes else None
        if cfg.stagger_episodes and self._clock is None:
            raise ValueError(
                f"stagger_episodes=True, but {type(env).__name__} has no EpisodeClock: set it to False"
            )
        self.env, self.policy, self.rollout_length = env, policy, rollout_length
        self._keys = None if keys is None else list(keys)
        self._root: TensorDict | None = None
        self._storage_TE: TensorDict | None = None
        self._leaves: list[tuple[NestedKey, Tensor]] = []
        device = env.device or torch.device("cpu")
        simulates = part(env, SimulatedWorld) is not None
        self._compiles = simulates if cfg.compile is None else cfg.compile
        self.compiled_step: CompiledStep | None = None
        self._run = Captured(
            self._rollout, device=device, warmup=cfg.warmup, require_graphs=cfg.require_graphs
        )

    @torch.no_grad()
    def collect(self) -> TensorDict:
        """Run T steps and return the rollout, `["E","T"]`, whose memory the next call overwrites."""
        self.warm_up()
        self._run()
        if isinstance(self.env, MaskedReset):
            # The env's own reference points into the graph's memory, which the next replay overwrites.
            self.env.last_root = self._root
        return self._stored_rollout()

    @torch.no_grad()
    def warm_up(self) -> None:
        """Compile the env's step, if that has not been done and is wanted; env and draws are left as they were."""
        if self._root is None:
            self.reset()
        if not self._compiles or self.compiled_step is not None:
            return
        assert self._root is not None
        device = self._run.device
        with torch.random.fork_rng([device] if device.type == "cuda" else []), _exploring():
            tensordict = self.policy(self._root.copy())
            try:
                self.compiled_step = CompiledStep(self.env, self._root, tensordict)
            except RuntimeError as error:
                self._compiles = False
                warnings.warn(
                    f"THE ENV'S STEP IS NOT COMPILED, and slower: {error}", RuntimeWarning, stacklevel=2
                )
                return
        self._allocate(self.compiled_step.env_state_E)

    @torch.no_grad()
    def made_up_rollout(self) -> TensorDict:
        """Return a rollout of the policy's answers to observations that are zero, in the memory that `collect` fills.

        The env makes no step, and draws of the policy do not count.
        """
        device = self._run.device
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            env_state_E = self.policy(self.env.fake_tensordict())
        for t in range(self.rollout_length):
            self._store(t, env_state_E)
        return self._stored_rollout()

    def _stored_rollout(self) -> TensorDict:
        assert self._storage_TE is not None
        return dims.name(self._storage_TE.transpose(0, 1), dims.E, dims.T)

    def __iter__(self) -> Iterator[TensorDict]:
        """Collect rollouts without end."""
        while True:
            yield self.collect()

    @torch.no_grad()
    def reset(self) -> None:
        """Reset all envs; the next rollout starts there."""
        root_E = self.env.reset()
        if self._root is None:
            self._root = root_E.clone()
        else:
            self._root.update_(root_E)
        if self._clock is not None:
            self._clock.stagger_episodes_()

    def state_dict(self) -> dict[str, Shaped[Tensor, " E *?leaf"]]:
        """Return the EnvState from which the next rollout starts, by flat key."""
        if self._root is None:
            return {}
        return self._root.clone().flatten_keys(".").to_dict()

    @torch.no_grad()
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state_dict` of such a collector; the env's own state is loaded apart."""
        if self._root is None:
            self.reset()
        assert self._root is not None
        what = "state of another collector (build the env with the same num_envs)"
        copy_into(self._root.flatten_keys(".").to_dict(), state, what=what)

    def _rollout(self) -> None:
        assert self._root is not None
        root_keys = list(self._root.keys(True, True))
        root_E = self._root.copy()
        with _exploring(), getattr(self.policy, "steady", nullcontext)():
            if self.compiled_step is not None:
                for t in range(self.rollout_length):
                    env_state_E = self.policy(self._root.copy())
                    self._store(t, env_state_E)  # before the step writes its root over this one
                    self._store(t, self.compiled_step(env_state_E))
                return
            for t in range(self.rollout_length):
                env_state_E, root_E = self.env.step_and_maybe_reset(self.policy(root_E))
                self._store(t, env_state_E)
                root_E = root_E.select(*root_keys)
        for key in root_keys:
            self._root.get(key).copy_(root_E.get(key))

    def _store(self, t: int, env_state_E: TensorDictBase) -> None:
        if self._storage_TE is None:
            self._allocate(env_state_E)
        held = [(leaf_TE[t], env_state_E.get(key, None)) for key, leaf_TE in self._leaves]
        pairs = [(kept, value) for kept, value in held if value is not None]
        copy_rows([kept for kept, _ in pairs], [value for _, value in pairs])

    def _allocate(self, env_state_E: TensorDictBase) -> None:
        produced = list(env_state_E.keys(True, True))
        for key in self._keys or []:
            if key not in produced:
                raise ValueError(
                    f"keys: no step produces {key!r}; it produces {sorted(map(spell, produced))}"
                )
        kept_E = env_state_E.select(*(self._keys or produced))
        storage_TE: Any = kept_E.new_zeros(torch.Size([self.rollout_length, *kept_E.batch_size]))
        self._storage_TE = storage_TE
        self._leaves = list(storage_TE.items(True, True))
