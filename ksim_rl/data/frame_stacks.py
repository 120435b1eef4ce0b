"""Stacks of the last frames of a signal, of which a replay stores each frame once."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool, Int64, Shaped
from tensordict.utils import NestedKey
from torch import Tensor


class FrameStacks:
    """Puts stacks of frames together from a ring that holds, in each place of an env, the newest frame alone.

    The frame of k steps ago lies k places further back. `depth`, int64 by place, says how many places back the frames
    of its episode go, at most `reach`; frames from before stand for the first one, as `ObservationHistory` repeats it.
    After a gap in what was written a stack may differ from the one that was seen: see `are_exact`.

    Attributes:
        ages: by how many env steps each frame of a stack [E, N, *frame] is older than the newest one, for each
            observation that is a stack; the oldest first, and 0 last.
        reach: places behind an env state that its longest stack reads.
    """

    def __init__(self, ages: Mapping[NestedKey, Sequence[int]], *, num_envs: int) -> None:
        for key, own in ages.items():
            is_sorted = list(own) == sorted(set(own), reverse=True)
            if not is_sorted or not own or own[-1] != 0:
                raise ValueError(
                    f"ages[{key!r}]={tuple(own)}: expected env steps that become fewer down to 0, such as (2, 1, 0)"
                )
        self.ages = {key: tuple(own) for key, own in ages.items()}
        self.num_envs = num_envs
        self.reach = max((own[0] for own in self.ages.values()), default=0)
        self.depth = torch.zeros(0, dtype=torch.int64)
        self._age_N: dict[NestedKey, Tensor] = {}

    def size_(self, num_rows: int, device: torch.device) -> None:
        """Make room for the depths of a ring of so many rows, which is all places of all envs."""
        self.depth = torch.zeros(num_rows, dtype=torch.int64, device=device)
        for key, own in self.ages.items():
            self._age_N[key] = torch.tensor(own, device=device)

    def newest(
        self, key: NestedKey, leaf_ET: Shaped[Tensor, "E T *leaf"]
    ) -> Shaped[Tensor, "E T *frame"]:
        """Return the part of an observation that the ring stores, as a view: a stack's newest frame, or all of it."""
        if key in self.ages:
            return leaf_ET[:, :, -1]
        return leaf_ET

    def read(
        self, key: NestedKey, rows: Shaped[Tensor, " R *frame"], index_B: Int64[Tensor, " B"]
    ) -> Shaped[Tensor, " B *leaf"]:
        """Return an observation of the env states at `index_B`, in the shape in which the env gives it."""
        if key not in self.ages:
            return rows[index_B]
        # No frame is older than the episode.
        places_BN = torch.minimum(self._age_N[key], self.depth[index_B][:, None])
        # The rows of one env are num_envs apart, and the ring closes at the end.
        return rows[(index_B[:, None] - places_BN * self.num_envs) % rows.shape[0]]

    def are_exact(
        self,
        rows: Shaped[Tensor, " R *frame"],
        index_ET: tuple[Int64[Tensor, "E T"], Int64[Tensor, "E T"]],
        seen_ET: tuple[Shaped[Tensor, "E T *leaf"], Shaped[Tensor, "E T *leaf"]],
        *,
        key: NestedKey,
        done_ET: Bool[Tensor, "E T"],
    ) -> Bool[Tensor, "E T"]:
        """Return where `read` gives both an observation and the one that follows it, as they were seen in a rollout.

        `index_ET` and `seen_ET` are of the observations and of those that follow them. It does not where a stack shows
        frames that were never written: an env was stepped in between, or written first in the middle of an episode.
        """
        now_ET, following_ET = seen_ET
        is_next_ET = self._is_read(rows, index_ET[1], following_ET, key=key)
        # Within an episode an observation lies where the one lies that followed, so that each stack is read once.
        is_now_ET = torch.empty_like(is_next_ET)
        is_now_ET[:, :1] = self._is_read(rows, index_ET[0][:, :1], now_ET[:, :1], key=key)
        goes_on_ET = is_next_ET[:, :-1] & _are_equal(now_ET[:, 1:], following_ET[:, :-1])
        # The first stack of an episode repeats its newest frame.
        begins_ET = _are_equal(now_ET[:, 1:], now_ET[:, 1:, -1:].expand_as(now_ET[:, 1:]))
        is_now_ET[:, 1:] = torch.where(done_ET[:, :-1], begins_ET, goes_on_ET)
        return is_now_ET & is_next_ET

    def _is_read(
        self,
        rows: Shaped[Tensor, " R *frame"],
        index_ET: Int64[Tensor, "E T"],
        seen_ET: Shaped[Tensor, "E T *leaf"],
        *,
        key: NestedKey,
    ) -> Bool[Tensor, "E T"]:
        """Return where `read` gives what was seen."""
        read_N = self.read(key, rows, index_ET.flatten())
        return _are_equal(read_N.view_as(seen_ET), seen_ET)

    def depths(
        self, first_E: Int64[Tensor, " E"], done_ET: Bool[Tensor, "E T"]
    ) -> Int64[Tensor, "E T"]:
        """Return the depth of each env state of a rollout, from the first one's depth and the ends of episodes."""
        step_T = torch.arange(done_ET.shape[1], device=done_ET.device)
        # The step at which the episode begins that a step belongs to; the first one has begun before the rollout.
        begins_ET = torch.where(done_ET, step_T + 1, -self.reach).roll(1, 1)
        begins_ET[:, 0] = -first_E
        return (step_T - begins_ET.cummax(1).values).clamp_max(self.reach)


def _are_equal(
    first_ET: Shaped[Tensor, "E T *leaf"], second_ET: Shaped[Tensor, "E T *leaf"]
) -> Bool[Tensor, "E T"]:
    return (first_ET == second_ET).flatten(2).all(2)
