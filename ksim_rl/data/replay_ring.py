"""The replay of off-policy learning: it holds the last env states of each env, and draws of them."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Int64, Shaped
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.data.replay_buffers import Sampler
from torchrl.data.replay_buffers.storages import Storage

from ksim_rl import dims, ranks
from ksim_rl.checked import Checked, Count, NonNegative, Repeats, Share, WholeNumber
from ksim_rl.checks import check_count, check_in_range, naming
from ksim_rl.data.dataset_storage import Stateless
from ksim_rl.data.epoch_sampler import Entries, SampleInfo, stored
from ksim_rl.data.offline import OfflineCfg, OfflineTable
from ksim_rl.data.replay_storage import ReplayStorage, ReplayWriter, SavedByStateDict
from ksim_rl.device.state_tree import State, branch, tensor


class ReplaySampler(Stateless, Sampler):
    """Draws env states of a `ReplayStorage`, each with the same probability, with replacement.

    A place is drawn among all that may hold an env state. Those that do not (terminal observations, env states that are
    not finite) are drawn again, up to `tries` times; any that are left then are masked: with a share q of such places,
    q^tries of a minibatch. The first that holds one is taken, so the draw is exactly uniform over the env states.
    Makes no host sync; numbers come from torch's default generator of the device. With `shards`, minibatches of
    `minibatch` have as many of each of so many equal parts of the envs, as ranks would draw.
    """

    def __init__(self, *, tries: int = 4, shards: int = 1, minibatch: int = 1) -> None:
        check_count("tries", tries)
        self.tries = tries
        self.shards = shards
        self.minibatch = minibatch

    def sample(self, storage: Storage, batch_size: int) -> tuple[Entries, SampleInfo]:
        """Return indices [B] and an empty info dict."""
        assert isinstance(storage, ReplayStorage)
        # All tries are drawn together: to draw again where a place is empty would need the host.
        shape = (self.tries, batch_size)
        device = storage.device
        env = ranks.randint(storage.num_envs // self.shards, shape, dim=1, device=device)
        if self.shards > 1:
            first_S = torch.arange(
                0, storage.num_envs, storage.num_envs // self.shards, device=device
            )
            # Part s of the batch is from the envs of shard s.
            env += first_S.repeat_interleave(batch_size // self.shards)
        # float64: float32 cannot tell the places of a ring of more than 2^24.
        unit = ranks.rand(shape, dim=1, dtype=torch.float64, device=device)
        # No place older than the fullest ring's oldest; envs that ended more episodes fill sooner.
        oldest = ranks.most_of(storage.filled_E.amax())
        # Age 1 is the newest env state: the place of the newest observation holds none.
        age = 1 + (unit * oldest.clamp_min(1)).to(torch.int64)
        index = storage.index(env, age)
        # The first try that holds an env state, or try 0 where none does.
        first = storage.available[index].to(torch.uint8).argmax(0, keepdim=True)
        index_B = index.gather(0, first).squeeze(0)
        if self.shards > 1:
            # From shard by shard to minibatch by minibatch, each with its part of every shard.
            in_shards = index_B.view(self.shards, -1, self.minibatch // self.shards)
            index_B = in_shards.transpose(0, 1).reshape(-1)
        return index_B, {}


class PrioritySampler(SavedByStateDict, Sampler):
    """Draws entries in proportion to (priority + eps)^alpha (Schaul et al., arXiv 1511.05952), with replacement.

    It stands in for TorchRL's `PrioritizedSampler` in any replay buffer whose storage has one dim, with the default
    priority of the paper: the highest so far, 1 at the start. Give it priorities by the buffer's
    `update_priority(index, priority)`; TorchRL's `update_tensordict_priority` does so for TorchRL's own sampler only.

    There is no tree: the cumulative sum over all priorities, in float64, and a binary search per draw are a few
    kernels, make no host sync and can be captured in a CUDA graph. The draws are stratified: one falls in each of B
    equal shares of the sum, as in the paper's appendix. The info dict has `priority_weight` [B]: (P(i) / min_j
    P(j))^-beta, at most 1, so that `beta=1` undoes the priorities wholly.
    """

    def __init__(
        self,
        max_capacity: int,
        *,
        alpha: float = 0.6,
        beta: float = 0.4,
        eps: float = 1e-8,
        device: torch.device | str = "cpu",
    ) -> None:
        check_in_range("alpha", alpha, low=0.0)
        check_in_range("beta", beta, low=0.0)
        check_in_range("eps", eps, low=0.0, low_open=True)
        self.alpha = alpha
        self.beta = beta
        self.eps = eps
        self._priority_N = torch.zeros(max_capacity, device=device)
        # The highest priority so far, which new entries get, so that each is drawn soon.
        self._highest = torch.zeros((), device=device)

    @torch.no_grad()
    def extend(self, index: Entries, **_: Any) -> None:
        """Give new entries the default priority."""
        default = self._default()
        index_N = torch.as_tensor(index, device=self._priority_N.device).reshape(-1)
        self._priority_N[index_N] = default.expand(index_N.shape[0])

    add = mark_update = extend

    @torch.no_grad()
    def update_priority(
        self,
        index: Entries,
        priority: float | Shaped[Tensor, "#*batch"],
        *,
        storage: Storage | None = None,
        **_: Any,
    ) -> None:
        """Set priorities [B] or [] of entries [B]; of an index that occurs twice the highest counts.

        One that is negative or not finite is taken as the default priority.
        """
        device = self._priority_N.device
        index_B = torch.as_tensor(index, device=device).reshape(-1)
        priority_B = torch.as_tensor(priority, dtype=torch.float32, device=device).reshape(-1)
        priority_B = priority_B.expand(index_B.shape[0])
        # A loss that is not finite says nothing about its entry.
        valid_B = priority_B.isfinite() & (priority_B >= 0.0)
        self._highest.copy_(
            torch.maximum(self._highest, torch.where(valid_B, priority_B, 0.0).amax())
        )
        priority_B = torch.where(valid_B, priority_B, self._default())
        # The highest of several: an order of writes would differ from run to run.
        self._priority_N.scatter_reduce_(0, index_B, priority_B, "amax", include_self=False)

    @torch.no_grad()
    def sample(self, storage: Storage, batch_size: int) -> tuple[Entries, SampleInfo]:
        """Return indices [B] and their weights."""
        if getattr(storage, "ndim", 1) > 1:
            raise ValueError(
                f"the storage has ndim={storage.ndim}: PrioritySampler draws from storages of one dim; use ndim=1 and "
                "extend by data with one batch dim"
            )
        # (priority + eps)^alpha of stored entries, and 0 elsewhere.
        score_N = (self._priority_N.to(torch.float64) + self.eps).pow(self.alpha)
        is_ring = isinstance(storage, ReplayStorage)
        if is_ring:
            score_N = torch.where(storage.available, score_N, 0.0)
        else:
            score_N = score_N[: stored(storage)]
        # Whole numbers, whose sum has no order: a GPU adds floats up otherwise each time. One takes up to 2^62 / N.
        unit = score_N.amax().clamp_min(1e-300) * (score_N.shape[0] / 2.0**62)
        upto_N = (score_N / unit).to(torch.int64).cumsum(0)
        device = upto_N.device
        # Stratified draws: number i lies in share i of B equal parts.
        share_B = torch.arange(batch_size, dtype=torch.float64, device=device)
        share_B = (
            share_B + torch.rand(batch_size, dtype=torch.float64, device=device)
        ) / batch_size
        # Rounding could lead past the last entry that has a score.
        has_score_N = score_N > 0.0
        last = (
            has_score_N.to(torch.int64).mul_(torch.arange(score_N.shape[0], device=device)).amax()
        )
        drawn_B = (share_B * upto_N[-1]).to(torch.int64)
        index_B = torch.searchsorted(upto_N, drawn_B, right=True)
        index_B = torch.minimum(index_B, last)
        lowest = torch.where(has_score_N, score_N, torch.inf).amin()
        # Where nothing has a score, the draws are masked: a finite weight keeps the losses' means finite.
        weight_B = (score_N[index_B] / lowest).pow(-self.beta).clamp_max(1.0).to(torch.float32)
        return index_B, {"priority_weight": weight_B}

    def state_dict(self) -> State:
        """Return the priorities."""
        return {"priority": self._priority_N, "highest": self._highest}

    @torch.no_grad()
    def load_state_dict(self, state_dict: State) -> None:
        """Continue where `state_dict` was taken; tensors keep their addresses."""
        self._priority_N.copy_(tensor(state_dict, "priority"))
        self._highest.copy_(tensor(state_dict, "highest"))

    def _empty(self) -> None:
        self._priority_N.zero_()
        self._highest.zero_()

    def _default(self) -> Tensor:
        """Return the highest priority so far, [], or 1 where there is none above zero."""
        return torch.where(self._highest > 0.0, self._highest, 1.0)


@dataclass(frozen=True, kw_only=True)
class ReplayCfg(Checked):
    """How many env states a rollout adds to the replay, how many it keeps, and how many a gradient step sees.

    One iteration is `num_steps` steps of each env and then `num_minibatches` gradient steps, so that there are
    `num_minibatches / num_steps` gradient steps per step. The recipe of FastTD3 alternates 1 step and u gradient steps;
    T steps and then T * u gradient steps is the same but for actions that are up to T - 1 steps older than the newest
    policy, and each iteration is only two graphs, whatever T is.

    From `learning_starts` until each env has made `policy_starts` steps only the critics learn: critics that know
    nothing would spoil a good policy that a run goes on from (PIRLNav, Ramrakhya et al., arXiv 2301.07302).

    With `offline` a share of each minibatch are recorded env states (RLPD, Ball et al., arXiv 2302.02948).

    Without `save_replay` checkpoints are small, and a resumed run begins with an empty replay and random actions until
    `learning_starts`, so that it is not the same run any more; steps until `policy_starts` are counted again, too.
    """

    num_env_states_per_minibatch: Count  # env states of a gradient step
    num_minibatches: Repeats  # per iteration
    num_steps: Count = 1  # of each env per iteration
    capacity: Count = 1024  # env states per env; the end of an episode takes one more
    n_step: Repeats = 1  # rewards that a target sums before it bootstraps
    learning_starts: Count = 10  # steps of each env with random actions before any update
    offline: OfflineCfg | None = None  # recorded episodes that each minibatch has a share of
    policy_starts: WholeNumber = 0  # steps of each env before the policy learns, too
    prioritized: bool = False  # by the last TD error (Schaul et al., arXiv 1511.05952)
    priority_alpha: NonNegative = 0.6  # how strongly the error counts; 0 is uniform
    priority_beta: Share = 0.4  # how far the weights of the losses undo that; 1 is wholly
    save_replay: bool = True  # in checkpoints, so that a resumed run goes on as it would have
    shards: Count = 1  # equal parts of the envs, each in all minibatches, as with ranks

    def _check_fields(self) -> None:
        """Refuse a ring that is too small for its rollouts."""
        super()._check_fields()
        # A rollout whose episodes all end together takes two places per env state, and must not overwrite itself.
        least = 2 * self.num_steps + self.n_step
        if self.capacity < least:
            raise ValueError(
                f"capacity={self.capacity} is less than 2 * num_steps + n_step = {least}: "
                "one rollout would overwrite itself; raise capacity"
            )
        if self.offline is not None:
            self.offline.part_of(self.num_env_states_per_minibatch)
            if self.prioritized:
                raise ValueError(
                    "prioritized=True with offline: priorities are of the replay alone; leave one of them out"
                )
        # Learning begins with the first whole rollout that reaches `learning_starts`.
        rollouts = max(1, math.ceil(self.learning_starts / self.num_steps))
        learns_at = rollouts * self.num_steps
        if 0 < self.policy_starts <= learns_at:
            raise ValueError(
                f"policy_starts={self.policy_starts} is not beyond step {learns_at}, at which learning starts with "
                f"learning_starts={self.learning_starts} and num_steps={self.num_steps}: the critics learn alone in "
                "between; raise it, or leave it at 0"
            )

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return the numbers of observation, action and reward in the ring, in a rollout and in all minibatches."""
        return {
            ("capacity",): 3 * num_envs * self.capacity,
            ("num_steps",): 3 * num_envs * self.num_steps,
            ("num_env_states_per_minibatch",): 3 * self.num_env_states_per_minibatch,
        }

    def rollout_length(self, num_envs: int) -> int:
        """Return T, which does not depend on the number of envs; these and minibatches have equal shards."""
        size = self.num_env_states_per_minibatch
        if self.offline is not None and self.offline.part_of(size) % self.shards:
            raise ValueError(
                f"shards={self.shards}: use a divisor of the {self.offline.part_of(size)} env states that are "
                f"offline.share={self.offline.share!r} of minibatches of {size}"
            )
        if num_envs % self.shards or size % self.shards:
            raise ValueError(
                f"shards={self.shards}: use a divisor of num_envs={num_envs} and of minibatches of {size}"
            )
        if self.prioritized and self.shards * ranks.size() > 1:
            raise ValueError(
                "prioritized=True: priorities are compared in one process without shards only"
            )
        return self.num_steps

    def with_absolute_paths(self) -> "ReplayCfg":
        """Return the same with the path of a folder that leads there from anywhere."""
        if self.offline is None:
            return self
        source = str(Path(self.offline.source).resolve())
        return replace(self, offline=replace(self.offline, source=source))

    def with_rollout_length(self, length: int, num_envs: int) -> "ReplayCfg":
        """Return the same with rollouts of `length` steps."""
        with naming(f"collector.rollout_length={length}"):
            return replace(self, num_steps=length)


class ReplayRing(ReplayBuffer):
    """Holds the last env states of each env and yields minibatches of B of them, with their successors n steps later.

    Its TorchRL parts are `ReplayStorage`, whose other arguments are `of_storage`, `ReplaySampler` or `PrioritySampler`,
    and `ReplayWriter`. `extend` takes rollouts `["E","T"]`. With `cfg.offline` minibatches have that share of
    `offline`, a table that has to be set, behind the env states of the ring, shard by shard. None of its methods makes
    a host sync, so all can be captured in a CUDA graph.
    """

    def __init__(self, cfg: ReplayCfg, **of_storage: Any) -> None:
        self._ring = ReplayStorage(capacity=cfg.capacity, n_step=cfg.n_step, **of_storage)
        size = cfg.num_env_states_per_minibatch
        if cfg.offline is None:
            self._num_offline = 0
        else:
            self._num_offline = cfg.offline.part_of(size)
        self._num_online = size - self._num_offline
        sampler: Sampler = ReplaySampler(shards=cfg.shards, minibatch=self._num_online)
        if cfg.prioritized:
            exponents = {"alpha": cfg.priority_alpha, "beta": cfg.priority_beta}
            sampler = PrioritySampler(self._ring.max_size, device=self._ring.device, **exponents)
        super().__init__(
            storage=self._ring,
            sampler=sampler,
            writer=ReplayWriter(),
            collate_fn=lambda data: data,
            batch_size=size,
        )
        self.cfg = cfg
        self.offline: OfflineTable | None = None

    @property
    def non_finite_count(self) -> Int64[Tensor, ""]:
        """Env states refused so far because an element was not finite, recorded ones included, on the device."""
        if self.offline is None:
            return self._ring.non_finite_count
        return self._ring.non_finite_count + self.offline.storage.non_finite_count

    @property
    def inexact_count(self) -> Int64[Tensor, ""]:
        """Env states dropped so far because a stack of frames cannot be put together, on the device."""
        return self._ring.inexact_count

    def cut(self, is_cut_E: Bool[Tensor, " E"] | None = None) -> None:
        """Let the next rollout of envs, None for all, follow on nothing: see `ReplayStorage.cut`."""
        self._ring.cut(is_cut_E)

    @property
    def num_stored(self) -> Int64[Tensor, ""]:
        """Env states that are stored, on the device."""
        return self._ring.available.sum()

    def minibatches(
        self, count: int, *, read: Callable[..., TensorDictBase] | None = None
    ) -> Iterator[TensorDictBase]:
        """Yield `count` minibatches `["B"]`, of env states as `read` gives them for their indices: else `env_states`.

        With priorities they have "priority_weight" and "index", and each is drawn when it is asked for, by the
        priorities of that moment.
        """
        read = read or self.env_states
        size = self.cfg.num_env_states_per_minibatch
        if not self.cfg.prioritized:
            # One gather for all minibatches: a fraction of the kernels.
            index, _ = self.sampler.sample(self._ring, count * self._num_online)
            drawn = [index]
            if self._num_offline:
                drawn.append(self._recorded(count))
            for minibatch_B in read(*drawn).split(size):
                yield dims.name(minibatch_B, dims.B)
            return
        for _ in range(count):
            index_B, info = self.sampler.sample(self._ring, size)
            minibatch_B = read(index_B).set("index", index_B)
            yield minibatch_B.set("priority_weight", info["priority_weight"][:, None])

    def env_states(
        self,
        index_N: Int64[Tensor, " N"],
        recorded_M: Int64[Tensor, " M"] | None = None,
    ) -> TensorDictBase:
        """Return the env states of whole minibatches, one after the other, for indices in ring and offline table."""
        online_N = self._ring.get(index_N)
        if recorded_M is None:
            return online_N
        assert self.offline is not None
        offline_M = self.offline.storage.get(recorded_M)
        # The ring keeps all leaves that it is given.
        online_N = online_N.select(*offline_M.keys(True, True))
        parts: list[TensorDictBase] = []
        # By shards inside of minibatches, as ranks have their rows, to which draws of the losses belong.
        of_shard = online_N.split(self._num_online // self.cfg.shards)
        recorded = offline_M.split(self._num_offline // self.cfg.shards)
        for online_B, offline_B in zip(of_shard, recorded, strict=True):
            parts += [online_B, offline_B]
        return TensorDict.cat(parts, dim=0)  # type: ignore[return-value]

    def _recorded(self, count: int) -> Entries:
        """Draw the recorded env states of so many minibatches."""
        if self.offline is None:
            raise RuntimeError(
                "data.offline is set, and the replay has no offline table: set `offline`"
            )
        sampler = ReplaySampler(shards=self.cfg.shards, minibatch=self._num_offline)
        index, _ = sampler.sample(self.offline.storage, count * self._num_offline)
        return index

    def state_dict(self) -> State:
        """Return the ring and its priorities, without `save_replay` neither, and the hash of a recording."""
        state: State = {}
        if self.cfg.save_replay:
            state = {"ring": self._ring.state_dict(), "sampler": self.sampler.state_dict()}
        if self.offline is None:
            return state
        # The recording itself stays in its folder.
        return {**state, "offline_sha256": self.offline.sha256}

    def load_state_dict(self, state_dict: State) -> None:
        """Continue where `state_dict` was taken; one without a ring empties it.

        A ValueError where the offline table is another one.
        """
        own = self.offline and self.offline.sha256
        if state_dict.get("offline_sha256") != own:
            raise ValueError(
                "data.offline.source: it is another recording than the checkpoint's, whose sha256 is "
                f"{state_dict.get('offline_sha256')}, and here {own}: give back the folder as it was"
            )
        if "ring" not in state_dict:
            self.empty()
            return
        self._ring.load_state_dict(branch(state_dict, "ring"))
        self.sampler.load_state_dict(dict(branch(state_dict, "sampler")))
