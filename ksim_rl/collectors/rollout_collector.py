"""Collects rollouts of fixed length from all envs, on a GPU as one CUDA graph."""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from jaxtyping import Shaped
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Compose, Transform
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ksim_rl import dims
from ksim_rl.checked import Checked, Count
from ksim_rl.checks import check_count
from ksim_rl.collectors.compiled_step import CompiledStep
from ksim_rl.collectors.recording import Policy, Recording
from ksim_rl.device.capture import Captured
from ksim_rl.device.copying import copy_rows
from ksim_rl.device.eager import eagerly
from ksim_rl.device.state_tree import State, copy_into
from ksim_rl.envs.contract import EpisodeClock, SimulatedWorld, part
from ksim_rl.envs.masked_reset import MaskedReset
from ksim_rl.transforms.row_transform import held_transforms
from ksim_rl.transforms.specs import spell


@dataclass(frozen=True, kw_only=True)
class CollectorCfg(Checked):
    """Options of `RolloutCollector` that a config may set.

    Attributes:
        require_graphs: fail where CUDA graphs are unavailable, instead of running slower with a warning.
        compile: fuse the operations of terms and transforms into few kernels, which are compared with the env's own
            steps before they are used, and again after 1, 2, 4, 8 ... rollouts: rollouts take less time, and equal the
            env's own up to rounding. None does so for envs with a `SimulatedWorld`.
        eager: run the Python of each step instead, without kernels and graphs, which takes much longer: for debugging,
            and for Python that changes from step to step.
        stagger_episodes: spread the time-outs of the envs over an episode's length at the first reset, if the env can.
            First episodes are then shorter than later ones, and so are their returns: the rise of both within the
            first episode's length is no learning.
        warmup: so many first rollouts on CUDA run eagerly.
        rollout_length: steps of each env, in the config of a run instead of the dataset's size, which then follows.
    """

    require_graphs: bool = False
    compile: bool | None = None
    eager: bool = False
    stagger_episodes: bool = False
    warmup: Count = 2
    rollout_length: Count | None = None

    def _check_fields(self) -> None:
        super()._check_fields()
        if self.eager and (self.compile or self.require_graphs):
            raise ValueError(
                "eager=True with compile or require_graphs, which ask for the opposite: leave one out"
            )


def _compiles(env: EnvBase, cfg: CollectorCfg) -> bool:
    """Whether the env's step is to become kernels; a ValueError where that is asked for and cannot be."""
    simulated = part(env, SimulatedWorld)
    records = simulated is not None and simulated.world.can_be_recorded
    # By default exactly where it can be done.
    if cfg.compile is None:
        return records
    if cfg.compile and simulated is not None and not records:
        raise ValueError(
            "collector.compile=True, but no kernel can step MuJoCo's C engine: leave compile out, or choose "
            "task.sim.engine=warp"
        )
    return cfg.compile


class Listener(Protocol):
    """Takes each rollout as soon as it is made, without waiting for the device: see `RolloutCollector.listeners`."""

    def record(self, rollout_ET: TensorDictBase, *, restarted: bool = False) -> None:
        """Take a rollout `["E","T"]`, before which all envs were reset if they have `restarted`."""

    def close(self) -> None:
        """Finish: no rollout follows."""


class RolloutCollector:
    """Runs `policy` in `env` for T steps at a time; envs that end are reset within the rollout.

    On CUDA the T steps of policy, physics, terms, transforms and resets are one graph: the first rollouts run eagerly
    (they warm the kernels up, and their data count), the next is captured, and from then on each is one launch. On CPU
    each control step's physics is one Warp graph and torch stays eager. When Python changes, the recording is made
    again; see `Recording`. A FrozenPythonError names Python that cannot be recorded.

    The rollout equals `EnvBase.rollout(T, policy, break_when_any_done=False, auto_reset=False)`. On
    CUDA the env's `step_and_maybe_reset` must not synchronize (`ManagerBasedRlEnv`, `MaskedTransformedEnv`); on CPU any
    TorchRL env of batch size [E] will do. The policy writes the action, and the tensors that training needs; one that
    has a context `steady()` acts within it, where its weights stay. Stored are the leaves at `keys`, None for all:
    fewer cost fewer bytes and less time. Without `explores` a policy gives its deterministic actions.

    Attributes:
        listeners: what is given each rollout, such as a recorder of episodes; `close` closes them.
    """

    def __init__(
        self,
        env: EnvBase,
        policy: Policy,
        *,
        rollout_length: int,
        keys: Sequence[NestedKey] | None = None,
        cfg: CollectorCfg | None = None,
        explores: bool = True,
    ) -> None:
        check_count("rollout_length", rollout_length)
        if len(env.batch_size) != 1:
            raise ValueError(f"env.batch_size={tuple(env.batch_size)}: expected one dim, [E]")
        cfg = cfg or CollectorCfg()
        # Looked up now, so that a missing clock is an error of the constructor.
        if cfg.stagger_episodes:
            self._clock = part(env, EpisodeClock)
        else:
            self._clock = None
        if cfg.stagger_episodes and self._clock is None:
            raise ValueError(
                f"stagger_episodes=True, but {type(env).__name__} has no EpisodeClock: set it to False"
            )
        self.env = env
        self.policy = policy
        self.rollout_length = rollout_length
        self._keys = None if keys is None else list(keys)
        if explores:
            self._exploration = ExplorationType.RANDOM
        else:
            self._exploration = ExplorationType.DETERMINISTIC
        self.listeners: list[Listener] = []
        self._restarted = False
        self._root: TensorDict | None = None
        self._transforms: list[Transform] = []  # those that the running episodes have begun with
        self._storage_TE: TensorDict | None = None
        self._is_allocated = False
        self._leaves: list[tuple[NestedKey, Tensor]] = []
        device = env.device or torch.device("cpu")
        compiles = _compiles(env, cfg)
        # In an eager context the graph runs its Python at each call.
        with eagerly(cfg.eager):
            self._run = Captured(
                self._rollout, device=device, warmup=cfg.warmup, require_graphs=cfg.require_graphs
            )
        self._recording = Recording(
            env, policy, compiles=compiles and not cfg.eager, graph=self._run
        )

    @property
    def compiled_step(self) -> CompiledStep | None:
        """The env's step as kernels, if it has been compiled."""
        return self._recording.compiled_step

    @property
    def unchecked_rollouts(self) -> int:
        """How many rollouts have been made since the recorded step was last compared with the env's own."""
        return self._recording.unchecked_rollouts

    @torch.no_grad()
    def collect(self) -> TensorDict:
        """Run T steps and return the rollout, `["E","T"]`, whose memory the next call overwrites."""
        self.warm_up()
        assert self._root is not None
        # Python has changed: leaves and reset values may be others, so storage and kernels are made again.
        if self._recording.before_rollout(self._root, self._act):
            # New transforms may need a reset before the first step with them.
            self._renew_root()
            self._is_allocated = False
            self.warm_up()
        self._run()
        if isinstance(self.env, MaskedReset):
            # The env's own reference points into the graph's memory, which the next replay overwrites.
            self.env.last_root = self._root
        rollout_ET = self._stored_rollout()
        for listener in self.listeners:
            listener.record(rollout_ET, restarted=self._restarted)
        self._restarted = False
        return rollout_ET

    def close(self) -> None:
        """Close the listeners; the env stays as it is."""
        for listener in self.listeners:
            listener.close()
        self.listeners = []

    @torch.no_grad()
    def warm_up(self) -> None:
        """Compile the env's step if compiling is on and has not been done; env and draws stay unchanged."""
        # A first reset gives the root, in whose memory all later roots are written.
        if self._root is None:
            self.reset()
        if not self._recording.wants_kernels:
            return
        assert self._root is not None
        self._recording.compile(self._root, self._act)
        if self.compiled_step is not None:
            self._allocate(self.compiled_step.env_state_E)

    def _act(self) -> TensorDictBase:
        """Return the policy's output for the present root; random numbers drawn meanwhile are put back."""
        assert self._root is not None
        device = self._run.device
        # A copy of the tree, as the policy adds its leaves to it.
        devices = [device] if device.type == "cuda" else []
        with torch.random.fork_rng(devices), set_exploration_type(self._exploration):
            return self.policy(self._root.copy())

    def _renew_root(self) -> None:
        """Reset all envs if transforms have changed the values that an episode begins with."""
        assert self._root is not None
        known = {id(transform) for transform in self._transforms}
        added = [one for one in held_transforms(self.env, Transform) if id(one) not in known]
        # A chain passes resets on; others that do not override this have nothing to do at one.
        begins = [
            one
            for one in added
            if type(one)._reset is not Transform._reset and type(one) is not Compose
        ]
        if begins or _kinds(self._root) != _kinds_of_roots(self.env):
            warnings.warn(
                "transforms have changed, and with them what an episode begins with: all envs are reset",
                RuntimeWarning,
                stacklevel=3,
            )
            self._root = None
            self.reset()

    @torch.no_grad()
    def made_up_rollout(self) -> TensorDict:
        """Return a rollout of the policy's answers to observations that are zero, in the memory that `collect` fills.

        The env makes no step, and draws of the policy do not count.
        """
        device = self._run.device
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            env_state_E = self.policy(self.env.fake_tensordict())
        # Fills all T rows with the same EnvState, which is enough for kernels to compile.
        for t in range(self.rollout_length):
            self._store(t, env_state_E)
        return self._stored_rollout()

    def _stored_rollout(self) -> TensorDict:
        assert self._storage_TE is not None
        # Stored as [T, E], so that each step writes one dense piece; seen as [E, T] by the algorithms.
        return dims.name(self._storage_TE.transpose(0, 1), dims.E, dims.T)

    def __iter__(self) -> Iterator[TensorDict]:
        """Collect rollouts without end."""
        while True:
            yield self.collect()

    @torch.no_grad()
    def reset(self) -> None:
        """Reset all envs; the next rollout starts there."""
        root_E = self.env.reset()
        self._restarted = True
        self._transforms = list(held_transforms(self.env, Transform))
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
    def load_state_dict(self, state: State) -> None:
        """Continue from a `state_dict` of such a collector; the env's own state is loaded apart."""
        if self._root is None:
            self.reset()
        assert self._root is not None
        what = "state of another collector (build the env with the same num_envs)"
        copy_into(self._root.flatten_keys(".").to_dict(), state, what=what)
        # Episodes go on that ran when the state was taken: a reset of before is undone.
        self._restarted = False

    def _rollout(self) -> None:
        assert self._root is not None
        # The policy's leaves are dropped between steps, so that they do not pile up in the root.
        root_keys = list(self._root.keys(True, True))
        root_E = self._root.copy()
        steady = getattr(self.policy, "steady", nullcontext)
        with set_exploration_type(self._exploration), steady():
            if self.compiled_step is not None:
                for t in range(self.rollout_length):
                    env_state_E = self.policy(self._root.copy())
                    self._store(t, env_state_E)  # before the step writes its root over this one
                    self._store(t, self.compiled_step(env_state_E))
                return
            for t in range(self.rollout_length):
                # The env's own Python; the first calls are watched for values that a graph would freeze.
                with self._recording.calling():
                    env_state_E, root_E = self.env.step_and_maybe_reset(self.policy(root_E))
                self._store(t, env_state_E)
                root_E = root_E.select(*root_keys)
        # A graph reads the next rollout's root from the same memory, so it is copied and not replaced.
        for key in root_keys:
            self._root.get(key).copy_(root_E.get(key))

    def _store(self, t: int, env_state_E: TensorDictBase) -> None:
        if not self._is_allocated:
            self._allocate(env_state_E)
        # Policy leaves and env leaves are stored by two calls, so either may lack some of the keys.
        kept = []
        values = []
        for key, leaf_TE in self._leaves:
            value = env_state_E.get(key, None)
            if value is not None:
                kept.append(leaf_TE[t])
                values.append(value)
        # One kernel copies all leaves.
        copy_rows(kept, values)

    def _allocate(self, env_state_E: TensorDictBase) -> None:
        # Here all keys of a step are known: a wrong name in `keys` is an error.
        produced = list(env_state_E.keys(True, True))
        for key in self._keys or []:
            if key not in produced:
                raise ValueError(
                    f"keys: no step produces {key!r}; it produces {sorted(map(spell, produced))}"
                )
        kept_E = env_state_E.select(*(self._keys or produced))
        self._is_allocated = True
        # Keep the memory where it fits, since algorithms and graphs hold its addresses.
        if self._storage_TE is not None and not self._is_for_others(kept_E):
            return
        storage_TE: Any = kept_E.new_zeros(torch.Size([self.rollout_length, *kept_E.batch_size]))
        self._storage_TE = storage_TE
        self._leaves = list(storage_TE.items(True, True))

    def _is_for_others(self, kept_E: TensorDictBase) -> bool:
        """Whether the present memory was made for other leaves; a ValueError where a leaf has another shape now.

        Readers of rollouts may hold on to their memory, and were made for leaves of these shapes.
        """
        assert self._storage_TE is not None
        present = _kinds(self._storage_TE[0])
        wanted = _kinds(kept_E)
        for key in present.keys() & wanted.keys():
            if present[key] != wanted[key]:
                raise ValueError(
                    f"{spell(key)} was {present[key]} and is {wanted[key]} since transforms of the env have changed: "
                    "make another collector, and networks for it"
                )
        return present.keys() != wanted.keys()


def _kinds(tensordict: TensorDictBase) -> dict[NestedKey, str]:
    """Return dtype and shape of each leaf."""
    return {key: f"{leaf.dtype} {list(leaf.shape)}" for key, leaf in tensordict.items(True, True)}


def _kinds_of_roots(env: EnvBase) -> dict[NestedKey, str]:
    return _kinds(env.full_observation_spec.zero()) | _kinds(env.full_done_spec.zero())
