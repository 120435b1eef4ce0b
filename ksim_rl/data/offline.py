"""Lays recorded episodes out as a replay, from which each minibatch of an off-policy update takes a share."""

import hashlib
import heapq
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Int64
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor

from ksim_rl.checked import Checked, Filled, Within
from ksim_rl.data.dataset_storage import finite_rows
from ksim_rl.data.episode_folder import EPISODE_KEY
from ksim_rl.data.replay_storage import DONE, REWARD, TERMINATED, ReplayStorage, made_finite
from ksim_rl.device.group import first_row, size
from ksim_rl.device.room import check_bytes
from ksim_rl.transforms.specs import spell

A_FOLDER = "name a folder of episodes, data.offline.source=FOLDER"


@dataclass(frozen=True, kw_only=True)
class OfflineCfg(Checked):
    """Recorded episodes that an off-policy run learns from beside its own replay (RLPD, Ball et al., arXiv 2302.02948).

    Attributes:
        source: a folder of episodes.
        share: of each minibatch that is drawn from them.
    """

    source: Annotated[str, Filled(A_FOLDER)]
    share: Annotated[float, Within(low=0.0, high=1.0, low_open=True)] = 0.5

    def part_of(self, minibatch: int) -> int:
        """Return how many env states of a minibatch are recorded ones; a ValueError where that is no whole number."""
        part = round(self.share * minibatch)
        if abs(part - self.share * minibatch) > 1e-6 or not 0 < part < minibatch:
            raise ValueError(
                f"offline.share={self.share!r} of num_env_states_per_minibatch={minibatch} is no whole number of env "
                "states between none and all: use another share, such as 0.5"
            )
        return part


@dataclass(frozen=True, kw_only=True)
class OfflineTable:
    """Recorded env states on a device, at addresses that never change, and the hash of all of them.

    The storage has a ring for each shard of the data and each rank, with whole episodes; nothing is added any more.
    """

    storage: ReplayStorage
    sha256: str


def offline_keys(observations: list[NestedKey]) -> list[NestedKey]:
    """Return the leaves of recorded env states that off-policy learning reads."""
    following: list[NestedKey] = [unravel_key(("next", key)) for key in observations]
    return [*observations, "action", *following, REWARD, DONE, TERMINATED]


def make_offline_table(
    env_states_D: TensorDictBase,
    *,
    observations: list[NestedKey],
    shards: int = 1,
    n_step: int = 1,
    gamma: float = 0.99,
    device: torch.device | str = "cpu",
    beside: int = 0,
) -> OfflineTable:
    """Lay out recorded env states `["D"]`, with the `offline_keys` and "episode", of which a rank keeps its part.

    A ValueError says where rows do not follow one another, what has no end, and what no memory holds, which has to hold
    `beside` bytes of a replay, too. Rows with a number that is not finite are counted and never drawn.
    """
    episode_D = env_states_D.get(EPISODE_KEY)
    rows_D = env_states_D.select(*offline_keys(observations))
    is_last_D = torch.ones_like(episode_D, dtype=torch.bool)
    is_last_D[:-1] = episode_D[1:] != episode_D[:-1]
    _check_rows(rows_D, observations, is_last_D)

    lanes = _Lanes.of(episode_D, num_lanes=shards * size())
    # This rank's part of them.
    first = first_row(shards)
    own_D = (lanes.lane_D >= first) & (lanes.lane_D < first + shards)
    # A place is a row of the storage at place * shards + lane.
    index_N = (lanes.place_D * shards + lanes.lane_D - first)[own_D]
    ends_N = is_last_D[own_D]
    kept = [*observations, "action", REWARD, DONE, TERMINATED]
    places = int(lanes.taken_E.max()) + 1
    row_bytes = sum(rows_D.get(key)[0].nbytes for key in kept)
    given = f"{rows_D.shape[0]:,} recorded env states"
    fix = "record fewer, or smaller observations"
    if beside:
        given += " beside the replay"
        fix += ", or lower data.capacity"
    needed = places * shards * row_bytes + beside
    check_bytes(given, needed, device=torch.device(device), fix=fix)
    own = {spell(key): rows_D.get(key)[own_D] for key in offline_keys(observations)}
    content = {}
    for key in kept:
        value_N = made_finite(own[spell(key)])
        content[spell(key)] = stored = value_N.new_zeros(places * shards, *value_N.shape[1:])
        stored[index_N] = value_N
        if key in observations:
            # The observation that an episode ends with takes a place of its own.
            following_N = own[spell(unravel_key(("next", key)))]
            stored[index_N[ends_N] + shards] = made_finite(following_N[ends_N])
    finite_N = finite_rows(own.values())[:, 0]
    available = torch.zeros(places * shards, dtype=torch.bool)
    available[index_N] = finite_N
    taken_E = lanes.taken_E[first : first + shards]
    storage = ReplayStorage(
        num_envs=shards,
        capacity=places - 1,
        observations=observations,
        n_step=n_step,
        gamma=gamma,
        device=device,
    )
    storage.load_state_dict(
        {
            "content": content,
            "available": available,
            "head": taken_E,
            "filled": taken_E,
            "non_finite_count": (~finite_N).sum(),
        }
    )
    return OfflineTable(storage=storage, sha256=_sha256(rows_D))


@dataclass(frozen=True)
class _Lanes:
    """Where env states lie: lane and place of each, and how many places of each of E lanes are taken."""

    lane_D: Int64[Tensor, " D"]
    place_D: Int64[Tensor, " D"]
    taken_E: Int64[Tensor, " E"]

    @classmethod
    def of(cls, episode_D: Int64[Tensor, " D"], *, num_lanes: int) -> "_Lanes":
        """Assign each episode to the lane that is shortest so far."""
        length_N = episode_D.bincount()
        if len(length_N) < num_lanes:
            raise ValueError(
                f"{len(length_N)} episodes cannot be shared by {num_lanes} shards or ranks, as "
                "each takes whole ones: record more"
            )
        filled = [(0, lane) for lane in range(num_lanes)]
        lane_N = torch.zeros_like(length_N)
        start_N = torch.zeros_like(length_N)
        # The longest first, so that lanes become about equal.
        for episode in length_N.argsort(descending=True, stable=True).tolist():
            taken, lane = heapq.heappop(filled)
            lane_N[episode] = lane
            start_N[episode] = taken
            # One more, for the observation that it ends with.
            heapq.heappush(filled, (taken + int(length_N[episode]) + 1, lane))
        first_row_N = length_N.cumsum(0) - length_N
        step_D = torch.arange(len(episode_D)) - first_row_N[episode_D]
        by_lane = sorted(filled, key=lambda entry: entry[1])
        return cls(
            lane_D=lane_N[episode_D],
            place_D=start_N[episode_D] + step_D,
            taken_E=torch.tensor([taken for taken, _ in by_lane]),
        )


def _check_rows(
    rows_D: TensorDictBase, observations: list[NestedKey], is_last_D: Bool[Tensor, " D"]
) -> None:
    """Refuse episodes that do not end where they end, and env states that are not followed by the next one."""
    done_D = rows_D.get(DONE).reshape(-1)
    if not torch.equal(done_D, is_last_D):
        row = int((done_D != is_last_D).nonzero()[0])
        raise ValueError(
            f"'next/done' of env state {row} is {bool(done_D[row])}, and its episode "
            f"{'ends' if is_last_D[row] else 'goes on'} there"
        )
    for key in observations:
        now_D = rows_D.get(key)[1:]
        followed_D = rows_D.get(unravel_key(("next", key)))[:-1]
        # What is not finite is equal to nothing, and is never drawn.
        same_D = (now_D == followed_D) | (now_D != now_D) | (followed_D != followed_D)
        same_D = same_D.reshape(len(now_D), -1).all(1) | is_last_D[:-1]
        if not same_D.all():
            row = int((~same_D).nonzero()[0])
            raise ValueError(
                f"{spell(key)!r} after env state {row} is not what its 'next' says: rows of an "
                "episode have to follow one another"
            )


def _sha256(rows_D: TensorDictBase) -> str:
    found = hashlib.sha256()
    named: Mapping[str, Tensor] = {spell(key): value for key, value in rows_D.items(True, True)}
    for name in sorted(named):
        found.update(name.encode())
        found.update(named[name].contiguous().numpy().tobytes())
    return found.hexdigest()
