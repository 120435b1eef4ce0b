"""Keeps the last env states of each env in a ring, which stores each observation once."""

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any

import torch
from jaxtyping import Bool, Int64, Shaped
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data.replay_buffers.storages import Storage

from ksim_rl import dims
from ksim_rl.data.dataset_storage import MASK_KEY, DatasetWriter
from ksim_rl.data.epoch_sampler import Entries
from ksim_rl.data.frame_stacks import FrameStacks
from ksim_rl.device.state_tree import State, branch, copy_into, tensor, tensors

REWARD: NestedKey = ("next", "reward")
DONE: NestedKey = ("next", "done")
TERMINATED: NestedKey = ("next", "terminated")
STEPS: NestedKey = "steps_to_next_obs"
_LEAVES = (REWARD, DONE, TERMINATED)


class SavedByStateDict:
    """The part of TorchRL storages and samplers that are saved by their `state_dict` alone, as checkpoints do."""

    def dumps(self, path: str | PathLike[str]) -> None:
        """Refuse, as does `loads`."""
        raise NotImplementedError(
            f"a {type(self).__name__} is saved by its state_dict() and restored by load_state_dict()"
        )

    loads = dumps


class ReplayStorage(SavedByStateDict, Storage):
    """A TorchRL storage of the last `capacity` env states of E envs, at addresses that never change.

    Each env has a ring of places. An env state takes one: its observation, action, reward and flags. The observation
    that follows it lies in the next place, with the next env state; only where an episode ends is a place spent
    on the terminal observation. So an env state costs its observation once, not twice: for Go1 (120 observed numbers,
    12 actions) 535 bytes instead of 1015, 2.2 GB for 1000 env states of 4096 envs. One more place holds the newest one.

    `write` and `get` make no host sync and can be captured in a CUDA graph: the next one's place is on the device.

    `get` returns env states and their successors `n_step` steps on: ("next", "reward") is the sum of discounted rewards
    until then, and "steps_to_next_obs" says how many they are, as TorchRL's losses read it. The sum ends early at the
    end of an episode, whose terminal observation follows, at an env state that is not finite, and at the newest one.

    An env state with an element that is not finite is stored as invalid, with zeros for such elements, and counted.
    So is one with a stack of frames that the ring cannot put together, as in the first steps after a gap in what was
    written: `inexact_count` counts it. Invalid places have ("collector", "mask") False, which TorchRL's losses leave
    out of their means. All that is stored is finite. Of the `observations`, which are stored once, each has a leaf at
    ("next", key) too.

    Rollouts of an env follow one another where the first observation is the newest one here. After a gap in which
    envs were reset or stepped that may be so by chance, as with pictures that are all black: tell it by `cut`.
    """

    def __init__(
        self,
        *,
        num_envs: int,
        capacity: int,
        observations: list[NestedKey],
        n_step: int = 1,
        gamma: float = 0.99,
        stacks: Mapping[NestedKey, Sequence[int]] | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.capacity = capacity
        self.stacks = FrameStacks(stacks or {}, num_envs=num_envs)
        # One more, for the newest observation, whose env state is not complete yet.
        self.places = capacity + 1 + self.stacks.reach
        super().__init__(self.places * num_envs)
        self.num_envs = num_envs
        self.n_step = n_step
        self.gamma = gamma
        self.device = torch.device(device)
        self.observations = list(observations)
        self.content: TensorDict | None = None
        # By place: whether it holds an env state. By env: the newest observation's place, and how many are filled.
        self.available = torch.zeros(self.max_size, dtype=torch.bool, device=self.device)
        self.head_E = torch.zeros(num_envs, dtype=torch.int64, device=self.device)
        self.filled_E = torch.zeros(num_envs, dtype=torch.int64, device=self.device)
        self.non_finite_count = torch.zeros((), dtype=torch.int64, device=self.device)
        self.inexact_count = torch.zeros((), dtype=torch.int64, device=self.device)
        # Of the next rollout: whether it follows on none of before.
        self._is_cut_E = torch.zeros(num_envs, dtype=torch.bool, device=self.device)
        self._env_E = torch.arange(num_envs, device=self.device)
        self.stacks.size_(self.max_size, self.device)

    def index(
        self, env: Int64[Tensor, "*batch"], age: Int64[Tensor, "*batch"]
    ) -> Int64[Tensor, "*batch"]:
        """Return the index of the env state that lies `age` >= 1 places behind the newest observation of `env`."""
        return (self.head_E[env] - age) % self.places * self.num_envs + env

    @torch.no_grad()
    def cut(self, is_cut_E: Bool[Tensor, " E"] | None = None) -> None:
        """Let the next rollout of envs, None for all, follow on nothing: they were reset, or stepped, in between."""
        if is_cut_E is None:
            self._is_cut_E.fill_(True)
        else:
            self._is_cut_E.logical_or_(is_cut_E)

    @torch.no_grad()
    def write(self, rollout_ET: TensorDictBase) -> Int64[Tensor, " N"]:
        """Add a rollout `["E","T"]` that cannot overwrite itself; return the indices of its N = E * T env states."""
        if rollout_ET.batch_dims != 2 or rollout_ET.shape[0] != self.num_envs:
            raise ValueError(
                f"the rollout has batch_size {tuple(rollout_ET.batch_size)}: expected [{self.num_envs}, T]"
            )
        length = rollout_ET.shape[1]
        if self.capacity + 1 < 2 * length + self.n_step:
            raise ValueError(
                f"a rollout of {length} steps can overwrite itself in a ring of {self.capacity} env states per env: "
                f"capacity must be at least {2 * length + self.n_step - 1}"
            )
        if self.content is None:
            self._allocate(rollout_ET)
        assert self.content is not None

        # An env state takes one place, and at the end of an episode one more for the terminal observation.
        done_ET = rollout_ET.get(DONE).reshape(self.num_envs, length)
        places_ET = 1 + done_ET.to(torch.int64)
        # Places taken by the rollout before each step, so that all of it is written in one go.
        before_ET = places_ET.cumsum(1) - places_ET
        goes_on_E = self._cut_where_not_continued(rollout_ET)
        place_ET = self.head_E[:, None] + before_ET
        # A place of an env is a row of the storage at place * num_envs + env.
        index_N = (place_ET % self.places * self.num_envs + self._env_E[:, None]).flatten()
        following_N = (
            (place_ET + 1) % self.places * self.num_envs + self._env_E[:, None]
        ).flatten()

        if self.stacks.reach:
            depth_E = torch.where(goes_on_E, self.stacks.depth[self._head_index()], 0)
            depth_N = self.stacks.depths(depth_E, done_ET).flatten()
            # Successors first, as for the env states below.
            self.stacks.depth[following_N] = (depth_N + 1).clamp_max(self.stacks.reach)
            self.stacks.depth[index_N] = depth_N
            # The first place of an episode follows none, and takes the oldest frame of another env state, too.
            self.available.index_fill_(0, self._beyond(index_N), False)
        # One element that is not finite makes its env state invalid, whichever leaf it is in.
        finite_N = torch.ones(self.num_envs * length, dtype=torch.bool, device=self.device)
        for key, leaf in self.content.items(True, True):
            if key in self.observations:
                # The successor of a rollout's last env state is the newest observation, until the next rollout
                # brings it as its first.
                finite_N &= self._put(key, leaf, following_N, rollout_ET.get(_next(key)))
            finite_N &= self._put(key, leaf, index_N, rollout_ET.get(key))
        # Stacks that show frames that were never written cannot be put together; after `reach` steps all can.
        known_ET = torch.ones_like(done_ET)
        for key in self.stacks.ages:
            known_ET &= self.stacks.are_exact(
                self.content.get(key),
                (index_N.view(done_ET.shape), following_N.view(done_ET.shape)),
                (rollout_ET.get(key), rollout_ET.get(_next(key))),
                key=key,
                done_ET=done_ET,
            )
        known_N = finite_N & known_ET.flatten()
        # First all successors: many are env states of this rollout and become available next.
        self._make_unavailable(following_N)
        self.available.index_copy_(0, index_N, known_N)
        self.non_finite_count.add_((~finite_N).sum())
        self.inexact_count.add_((finite_N & ~known_N).sum())
        # In place: a captured write finds the next places where this one has left them.
        taken_E = places_ET.sum(1)
        self.head_E.add_(taken_E).remainder_(self.places)
        self.filled_E.add_(taken_E).clamp_max_(self.capacity)
        # After the end of an episode the newest observation's place still has its env state of a round ago.
        head_E = self._head_index()
        self._make_unavailable(head_E)
        if self.stacks.reach:
            # An episode that begins there has no older frames.
            depth_E = self.stacks.depth[head_E]
            self.stacks.depth[head_E] = torch.where(done_ET[:, -1], 0, depth_E)
        return index_N

    @torch.no_grad()
    def get(self, index: Entries) -> TensorDict:
        """Return env states with their successors, `["B"]`, for their indices int64 [B]."""
        if self.content is None:
            raise RuntimeError("the replay is empty: extend it before sampling")
        index_B = torch.as_tensor(index, device=self.device).reshape(-1)
        reward_B, done_B, terminated_B, steps_B = self._return(index_B)
        # Rows of one env are num_envs apart, and the ring closes at the end of the storage.
        following_B = (index_B + steps_B * self.num_envs) % self.max_size
        sample = TensorDict({}, batch_size=index_B.shape, device=self.device)
        for key, leaf in self.content.items(True, True):
            # Rewards and flags cover all steps up to the successor, and are set below.
            if key not in _LEAVES:
                sample.set(key, self.stacks.read(key, leaf, index_B))
            if key in self.observations:
                sample.set(_next(key), self.stacks.read(key, leaf, following_B))
        sample.set(REWARD, reward_B[:, None])
        sample.set(DONE, done_B[:, None])
        sample.set(TERMINATED, terminated_B[:, None])
        sample.set(STEPS, steps_B[:, None])
        sample.set(MASK_KEY, self.available[index_B][:, None])
        return dims.name(sample, dims.B)

    def set(self, cursor: Entries, data: TensorDictBase, *, set_cursor: bool = True) -> None:
        """Refuse: a ring is written by whole rollouts."""
        raise ValueError(ReplayWriter.refusal)

    def __len__(self) -> int:
        """Return the number of places; those that hold no env state are masked."""
        if self.content is None:
            return 0
        return self.max_size

    def contains(self, item: Entries) -> bool:
        """Return whether an index holds an env state; reads the device."""
        return bool(self.available[item].all())

    def state_dict(self) -> State:
        """Return the ring and where its newest places are."""
        return {"content": self._leaves(), **self._counters()}

    def _leaves(self) -> dict[str, Tensor]:
        return {} if self.content is None else self.content.flatten_keys("/").to_dict()

    def _counters(self) -> dict[str, Tensor]:
        counters = {
            "available": self.available,
            "head": self.head_E,
            "filled": self.filled_E,
            "non_finite_count": self.non_finite_count,
        }
        if self.stacks.reach:
            counters["depth"] = self.stacks.depth
            counters["inexact_count"] = self.inexact_count
        return counters

    @torch.no_grad()
    def load_state_dict(self, state_dict: State) -> None:
        """Continue where `state_dict` was taken, with as many envs and places; tensors keep their addresses."""
        available = tensor(state_dict, "available")
        if available.shape != self.available.shape:
            raise ValueError(
                f"the checkpoint's replay has {available.numel()} places, this run's "
                f"{self.max_size}: num_envs, data.capacity and stacked frames must be the checkpoint's; before 0.2 "
                "replays held whole stacks"
            )
        # The ring may not exist yet in this run, or be filled where the checkpoint's is empty.
        content = tensors(branch(state_dict, "content"))
        if not content:
            self._empty()
        elif self.content is None:
            nested = {tuple(name.split("/")): leaf for name, leaf in content.items()}
            saved = TensorDict(nested, batch_size=[self.max_size])
            self.content = saved.new_zeros(saved.batch_size, device=self.device)
        own = self._counters()
        if content:
            copy_into(self._leaves(), content, what="the replay's content")
        # Replays of before did not count them.
        counted = {"inexact_count": torch.zeros_like(self.inexact_count), **state_dict}
        copy_into(own, {name: counted[name] for name in own}, what="the replay")
        self._is_cut_E.zero_()

    @torch.no_grad()
    def _empty(self) -> None:
        if self.content is None:
            content: Any = ()
        else:
            content = self.content.values(True, True)
        for each in (self.available, self.head_E, self.filled_E, *content):
            each.zero_()

    def _allocate(self, rollout_ET: TensorDictBase) -> None:
        produced = list(rollout_ET.keys(True, True))
        needed = (*self.observations, *map(_next, self.observations), *_LEAVES)
        missing = [key for key in needed if key not in produced]
        if missing:
            raise ValueError(f"the rollout lacks {missing}; it has {sorted(map(str, produced))}")
        # Under "next" only rewards and flags are stored: observations there lie in the next place.
        kept_ET = rollout_ET.select(
            *(key for key in produced if key[0] != "next" or key in _LEAVES)
        )
        for key in self.stacks.ages:
            kept_ET.set(key, self.stacks.newest(key, kept_ET.get(key)))
        # Asked for as a whole first: a refusal then names the size of all of it, and not of its first leaf.
        row = sum(leaf[0, 0].nbytes for leaf in kept_ET.values(True, True))
        torch.empty(self.max_size * row, dtype=torch.uint8, device=self.device)
        self.content = kept_ET.new_zeros(torch.Size([self.max_size]), device=self.device)

    def _head_index(self) -> Tensor:
        """Return the index of the newest observation of each env, [E]."""
        return self.head_E * self.num_envs + self._env_E

    def _cut_where_not_continued(self, rollout_ET: TensorDictBase) -> Tensor:
        """Drop the newest env state of envs that were reset in between: its successor is about to be overwritten.

        Returns the others, bool [E], where nothing was cut and the first observation of the rollout is the newest one.
        """
        assert self.content is not None
        head_E = self._head_index()
        goes_on_E = ~self._is_cut_E
        self._is_cut_E.zero_()
        for key in self.observations:
            first_E = self.stacks.newest(key, rollout_ET.get(key))[:, 0]
            same = self.content.get(key)[head_E] == first_E
            goes_on_E = goes_on_E & same.reshape(self.num_envs, -1).all(1)
        # After the end of an episode the newest env state lies one place further back, with all that follows it.
        last_E = self.index(self._env_E, torch.ones_like(self._env_E))
        self.available.index_copy_(0, last_E, self.available[last_E] & goes_on_E)
        return goes_on_E

    def _put(self, key: NestedKey, leaf: Tensor, index_N: Tensor, values_ET: Tensor) -> Tensor:
        """Write rows, and return which were finite, bool [N]; other elements become zero."""
        leaf[index_N] = made_finite(self.stacks.newest(key, values_ET).flatten(0, 1).to(leaf.dtype))
        if not leaf.is_floating_point():
            return torch.ones_like(index_N, dtype=torch.bool)
        # All frames of a stack; the older ones have been refused with their own env states.
        return values_ET.isfinite().reshape(index_N.numel(), -1).all(1)

    def _make_unavailable(self, row_N: Tensor) -> None:
        """Mark rows that hold no env state yet, and rows of env states whose place they take."""
        self.available.index_fill_(0, row_N, False)
        if self.stacks.reach:
            self.available.index_fill_(0, self._beyond(row_N), False)

    def _beyond(self, row_N: Tensor) -> Tensor:
        """Return the rows of the env states that no longer count: only their frames do, for those that follow."""
        return (row_N + self.stacks.reach * self.num_envs) % self.max_size

    def _return(self, start_B: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the sum of rewards, done, terminated and the number of steps to the successor, each [B]."""
        assert self.content is not None
        rewards, dones, ends = (self.content.get(key).reshape(-1) for key in _LEAVES)
        reward_B = rewards[start_B]
        done_B = dones[start_B]
        terminated_B = ends[start_B]
        steps_B = torch.ones_like(start_B)
        # A sum goes on while the env states are stored and the episode lasts.
        going_B = self.available[start_B] & ~done_B
        for step in range(1, self.n_step):
            index_B = (start_B + step * self.num_envs) % self.max_size
            # The place of the newest observation is not available, so no sum runs into the oldest env states.
            going_B = going_B & self.available[index_B]
            reward_B = reward_B + torch.where(going_B, self.gamma**step * rewards[index_B], 0.0)
            done_B = done_B | (going_B & dones[index_B])
            terminated_B = terminated_B | (going_B & ends[index_B])
            steps_B = steps_B + going_B
            going_B = going_B & ~dones[index_B]
        return reward_B, done_B, terminated_B, steps_B


def made_finite(leaf: Shaped[Tensor, "*leaf"]) -> Shaped[Tensor, "*leaf"]:
    """Return a leaf with zeros where it is not finite."""
    if leaf.is_floating_point():
        return leaf.nan_to_num(0.0, 0.0, 0.0)
    return leaf


class ReplayWriter(DatasetWriter):
    """Adds rollouts `["E","T"]` to a `ReplayStorage`."""

    refusal = "a replay is written by rollouts: use extend() with one of batch_size [E, T]"


def _next(key: NestedKey) -> NestedKey:
    return unravel_key(("next", key))
