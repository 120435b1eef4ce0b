"""Stacks of the last frames of a signal, of which a replay stores each frame once."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Int64, Shaped
from tensordict.utils import NestedKey
from torch import Tensor

from ksim_rl.checks import check_count


class FrameStacks:
    """Puts stacks of frames together from a ring that holds, in each place of an env, the newest frame alone.

    The frame of k steps ago lies k places further back. `depth`, int64 by place, says how many places back the frames
    of its episode go, at most `reach`; frames from before stand for the first one, as `ObservationHistory` repeats it.

    Attributes:
        num_frames: N of each observation that is a stack [E, N, *frame], its newest frame last.
        reach: places behind an env state that its longest stack reads.
    """

    def __init__(self, num_frames: Mapping[NestedKey, int], *, num_envs: int) -> None:
        for key, number in num_frames.items():
            check_count(f"num_frames[{key!r}]", number)
        self.num_frames = dict(num_frames)
        self.num_envs = num_envs
        self.reach = max(self.num_frames.values(), default=1) - 1
        self.depth = torch.zeros(0, dtype=torch.int64)

    def size_(self, num_rows: int, device: torch.device) -> None:
        """Make room for the depths of a ring of so many rows, which is all places of all envs."""
        self.depth = torch.zeros(num_rows, dtype=torch.int64, device=device)

    def newest(
        self, key: NestedKey, leaf_ET: Shaped[Tensor, "E T *leaf"]
    ) -> Shaped[Tensor, "E T *frame"]:
        """Return the part of an observation that the ring stores, as a view: a stack's newest frame, or all of it."""
        if key in self.num_frames:
            return leaf_ET[:, :, -1]
        return leaf_ET

    def read(
        self, key: NestedKey, rows: Shaped[Tensor, " R *frame"], index_B: Int64[Tensor, " B"]
    ) -> Shaped[Tensor, " B *leaf"]:
        """Return an observation of the env states at `index_B`, in the shape in which the env gives it."""
        if key not in self.num_frames:
            return rows[index_B]
        steps_ago_N = torch.arange(self.num_frames[key] - 1, -1, -1, device=index_B.device)
        # No frame is older than the episode.
        places_BN = torch.minimum(steps_ago_N, self.depth[index_B][:, None])
        # The rows of one env are num_envs apart, and the ring closes at the end.
        return rows[(index_B[:, None] - places_BN * self.num_envs) % rows.shape[0]]

    def begun(
        self,
        first: Mapping[NestedKey, Shaped[Tensor, "E *?leaf"]],
        content: Mapping[NestedKey, Shaped[Tensor, "R *?frame"]],
        head_E: Int64[Tensor, " E"],
    ) -> tuple[Int64[Tensor, " E"], Bool[Tensor, " E"]]:
        """Return the depth of the `first` stacks of a rollout, and in which envs the ring lacks their older frames.

        The ring has them where the rollout goes on from the newest observation, in row `head_E`, and needs none where
        a stack shows one frame, as after a reset.
        """
        goes_on_E = torch.ones_like(head_E, dtype=torch.bool)
        is_still_E = torch.ones_like(head_E, dtype=torch.bool)
        for key in self.num_frames:
            stack_EN = first[key]
            goes_on_E &= _equal_rows(self.read(key, content[key], head_E), stack_EN)
            is_still_E &= _equal_rows(stack_EN[:, -1:].expand_as(stack_EN), stack_EN)
        lacks_E = ~(goes_on_E | is_still_E)
        depth_E = torch.where(lacks_E, self.reach, 0)
        return torch.where(goes_on_E, self.depth[head_E], depth_E), lacks_E

    def depths(
        self, first_E: Int64[Tensor, " E"], done_ET: Bool[Tensor, "E T"]
    ) -> Int64[Tensor, "E T"]:
        """Return the depth of each env state of a rollout, from the first one's depth and the ends of episodes."""
        step_T = torch.arange(done_ET.shape[1], device=done_ET.device)
        # The step at which the episode begins that a step belongs to; the first one has begun before the rollout.
        begins_ET = torch.where(done_ET, step_T + 1, -self.reach).roll(1, 1)
        begins_ET[:, 0] = -first_E
        return (step_T - begins_ET.cummax(1).values).clamp_max(self.reach)

    def put_older_(
        self,
        content: Mapping[NestedKey, Shaped[Tensor, "R *?frame"]],
        first: Mapping[NestedKey, Shaped[Tensor, "E *?leaf"]],
        row_E: Int64[Tensor, " E"],
        *,
        steps_ago: int,
        where_E: Bool[Tensor, " E"],
    ) -> None:
        """Write the frames of `steps_ago` steps before the newest ones into a row of each env that the mask marks."""
        for key, stack_EN in first.items():
            if steps_ago >= self.num_frames[key]:
                continue
            rows = content[key]
            where = where_E.reshape(-1, *[1] * (rows.ndim - 1))
            # Other rows are put back, as no size depends on the mask.
            rows[row_E] = torch.where(where, stack_EN[:, -1 - steps_ago], rows[row_E])


def _equal_rows(a: Tensor, b: Tensor) -> Tensor:
    return (a == b).flatten(1).all(1)
