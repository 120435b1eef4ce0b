"""Records rollouts as whole episodes, on a disk, while the device goes on."""

import queue
import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Int64
from tensordict import TensorDictBase

from ksim_rl.checks import check_count
from ksim_rl.data.episode_folder import EPISODE_KEY, Key, Leaf
from ksim_rl.data.episode_writer import EpisodeWriter
from ksim_rl.device.room import check_bytes

# While one is written to the disk, the device fills the other.
NUM_BUFFERS = 2
DONE_KEY = ("next", "done")


@dataclass
class _HostBuffer:
    """A rollout in host memory, by leaf [T, E, ...], and the event after its copy."""

    leaves: dict[Key, torch.Tensor]
    arrived: torch.cuda.Event | None = None
    restarted: bool = False


class EpisodeRecorder:
    """Takes rollouts `["E","T"]` one after the other, and writes their whole episodes.

    A call starts a copy to pinned memory and returns; a thread waits for it, and writes. So the device never waits for
    the disk, until both buffers are full. Env e gives its first `episodes_E[e]` episodes, whatever their lengths: among
    the first episodes to end, short ones would be too many. With `starts_within` the first rollout begins within
    episodes, which are left out.

    `writer` is closed at the end; episodes that run then are not in it. `max_length` is the longest that an episode can
    be, in env states. An error of the thread, such as of a full disk, is raised by the next call. A recorder that is
    closed takes nothing more.
    """

    def __init__(
        self,
        writer: EpisodeWriter,
        *,
        episodes_E: Sequence[int],
        max_length: int,
        starts_within: bool = False,
    ) -> None:
        check_count("max_length", max_length)
        self._writer = writer
        self._episodes = _RunningEpisodes(
            writer, np.array(episodes_E), max_length=max_length, starts_within=starts_within
        )
        self._free: queue.Queue[_HostBuffer | None] = queue.Queue()
        self._full: queue.Queue[_HostBuffer | None] = queue.Queue()
        for _ in range(NUM_BUFFERS):
            self._free.put(None)
        self._is_done = threading.Event()
        self._failed: list[BaseException] = []
        self._is_closed = False
        self._thread = threading.Thread(target=self._write, name="episodes", daemon=True)
        self._thread.start()

    @property
    def is_done(self) -> bool:
        """Whether all episodes have been written that were asked for."""
        return self._is_done.is_set()

    def record(self, rollout_ET: TensorDictBase, *, restarted: bool = False) -> None:
        """Take a rollout; later work on the same stream may overwrite its memory.

        Where all envs have `restarted` before it, the episodes that ran until then never end, and are left out.

        Raises:
            ValueError: if the recorder is closed.
        """
        if self._is_closed:
            raise ValueError("the recorder is closed, and its folder is whole: make another one")
        buffer = self._free.get()
        self._raise_failure()
        # Rollouts may differ in length; a copy would repeat a step to fill a longer buffer.
        if buffer is None or not self._fits(buffer, rollout_ET):
            buffer = self._allocate(rollout_ET)
        for key, host_TE in buffer.leaves.items():
            # As the collector stores it, [T, E], each leaf is one piece.
            host_TE.copy_(rollout_ET.get(key).transpose(0, 1), non_blocking=True)
        if rollout_ET.device is not None and rollout_ET.device.type == "cuda":
            buffer.arrived = torch.cuda.Event()
            buffer.arrived.record(torch.cuda.current_stream(rollout_ET.device))
        buffer.restarted = restarted
        self._full.put(buffer)

    def close(self) -> None:
        """Write all rollouts that were taken, and close the folder."""
        self._is_closed = True
        self._full.put(None)
        self._thread.join()
        self._writer.close()
        self._raise_failure()

    def _fits(self, buffer: _HostBuffer, rollout_ET: TensorDictBase) -> bool:
        num_envs, num_steps = rollout_ET.batch_size
        return buffer.leaves[DONE_KEY].shape[:2] == (num_steps, num_envs)

    def _allocate(self, rollout_ET: TensorDictBase) -> _HostBuffer:
        pinned = rollout_ET.device is not None and rollout_ET.device.type == "cuda"
        leaves = {}
        for key in self._episodes.keys:
            value_TE = rollout_ET.get(key).transpose(0, 1)
            leaves[key] = torch.empty(value_TE.shape, dtype=value_TE.dtype, pin_memory=pinned)
        return _HostBuffer(leaves)

    def _raise_failure(self) -> None:
        if self._failed:
            raise self._failed[0]

    def _write(self) -> None:
        while (buffer := self._full.get()) is not None:
            if not self._failed:
                try:
                    self._write_one(buffer)
                # Whatever it is belongs to the thread that calls.
                except BaseException as error:
                    self._failed.append(error)
            # Also after a failure: who waits for a buffer must hear of it.
            self._free.put(buffer)

    def _write_one(self, buffer: _HostBuffer) -> None:
        if buffer.arrived is not None:
            buffer.arrived.synchronize()
        if buffer.restarted:
            self._episodes.restart()
        self._episodes.add({key: host_TE.numpy() for key, host_TE in buffer.leaves.items()})
        self._writer.commit()
        if self._episodes.all_written:
            self._is_done.set()

    def __enter__(self) -> "EpisodeRecorder":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _RunningEpisodes:
    """The episode that runs in each env, with room for `max_length` env states, until it has ended and is written."""

    def __init__(
        self,
        writer: EpisodeWriter,
        episodes_E: Int64[np.ndarray, " E"],
        *,
        max_length: int,
        starts_within: bool,
    ) -> None:
        self._writer = writer
        self._left_E = episodes_E
        self._max_length = max_length
        num_envs = len(episodes_E)
        leaves = [leaf for leaf in writer.contents.leaves if leaf.key != EPISODE_KEY]
        self.keys = [leaf.key for leaf in leaves]
        needed = num_envs * max_length * sum(leaf.num_bytes for leaf in leaves)
        check_bytes(
            f"recorded episodes of up to {max_length} env states",
            needed,
            num_envs=num_envs,
            device=torch.device("cpu"),
        )
        self._running = {leaf.key: _room(leaf, num_envs, max_length) for leaf in leaves}
        self._length_E = np.zeros(num_envs, dtype=np.int64)
        self._is_cut_E = np.full(num_envs, starts_within)

    @property
    def all_written(self) -> bool:
        """Whether no env has to give another episode."""
        return not self._left_E.any()

    def restart(self) -> None:
        """Drop the running episodes."""
        self._length_E[:] = 0
        self._is_cut_E[:] = False

    def add(self, rollout_TE: dict[Key, np.ndarray]) -> None:
        """Take the next T steps of each env, and write the episodes that end in them, in the order of their ends."""
        done_TE = rollout_TE[DONE_KEY][..., 0]
        for t, done_E in enumerate(done_TE):
            self._add_step({key: value_TE[t] for key, value_TE in rollout_TE.items()}, done_E)

    def _add_step(self, step_E: dict[Key, np.ndarray], done_E: Bool[np.ndarray, " E"]) -> None:
        # Envs that have given all their episodes are passed over.
        running = np.flatnonzero(self._left_E)
        at = self._length_E[running]
        if at.max(initial=0) >= self._max_length:
            raise ValueError(
                f"an episode has more than {self._max_length} env states, and the env says that none has: its "
                "max_episode_length is wrong"
            )
        for key, value_E in step_E.items():
            self._running[key][running, at] = value_E[running]
        self._length_E[running] += 1
        for env in running[done_E[running]]:
            self._end(env)

    def _end(self, env: int) -> None:
        length = self._length_E[env]
        self._length_E[env] = 0
        if self._is_cut_E[env]:
            self._is_cut_E[env] = False
            return
        self._writer.append({key: room_ET[env, :length] for key, room_ET in self._running.items()})
        self._left_E[env] -= 1


def _room(leaf: Leaf, num_envs: int, max_length: int) -> np.ndarray:
    shape = (num_envs, max_length, *leaf.shape)
    return np.zeros(shape, dtype=torch.empty(0, dtype=leaf.torch_dtype).numpy().dtype)


def leaves_of(env_state_E: TensorDictBase) -> list[Leaf]:
    """Return the leaves of an EnvState `["E"]`, or of a rollout `["E","T"]`, for an `EpisodeWriter`."""
    leaves = []
    for key, value in env_state_E.items(True, True):
        names = (key,) if isinstance(key, str) else key
        dtype = str(value.dtype).removeprefix("torch.")
        shape = tuple(value.shape[env_state_E.batch_dims :])
        leaves.append(Leaf(key=names, shape=shape, dtype=dtype))
    return leaves
