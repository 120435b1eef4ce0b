"""Whole episodes go to a folder and come back: by this library, by TensorDict alone, and by TorchRL's samplers."""

import json
import os
import random
import resource
import shutil
import signal
import time

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import ReplayBuffer, TensorStorage
from torchrl.data.replay_buffers import (
    RandomSampler,
    SamplerWithoutReplacement,
    SliceSampler,
)

from ksim_rl import data, dims
from ksim_rl.data.episode_folder import Contents, Leaf, Origin
from ksim_rl.data.episode_recorder import EpisodeRecorder, leaves_of
from ksim_rl.data.episode_writer import EpisodeWriter
from ksim_rl.files import writing
from ksim_rl.testing.counter_env import CounterEnv

LENGTHS = (3, 5, 2)


def rollout_of(num_envs, steps, seed=0):
    """A rollout of made-up numbers, in which env e ends its episodes after LENGTHS[e] steps."""
    generator = torch.Generator().manual_seed(seed)
    shape = (num_envs, steps)
    step_ET = torch.arange(steps).expand(shape)
    length_E = torch.tensor(LENGTHS[:num_envs])
    done_ET = (step_ET + 1) % length_E[:, None] == 0
    rollout = TensorDict(
        {
            "obs": {"x": torch.randn(*shape, 2, generator=generator), "step": step_ET[..., None]},
            "rgb": torch.randint(0, 255, (*shape, 4, 5, 3), dtype=torch.uint8, generator=generator),
            "action": torch.randn(*shape, 1, generator=generator),
            "next": {
                "obs": {"x": torch.randn(*shape, 2, generator=generator)},
                "reward": torch.randn(*shape, 1, generator=generator),
                "done": done_ET[..., None],
            },
        },
        batch_size=shape,
    )
    return dims.name(rollout, "E", "T")


def record(folder, rollout_ET, episodes_E, *, pieces=1, **how):
    """Record a rollout in pieces of equal length."""
    writer = EpisodeWriter(
        folder, leaves_of(rollout_ET), origin=Origin(task="made_up", step_dt=0.02)
    )
    steps = rollout_ET.shape[1] // pieces
    with EpisodeRecorder(writer, episodes_E=episodes_E, max_length=max(LENGTHS), **how) as recorder:
        for number in range(pieces):
            recorder.record(rollout_ET[:, number * steps : (number + 1) * steps])
    return recorder


@pytest.fixture
def folder(tmp_path):
    record(tmp_path / "episodes", rollout_of(3, 12), (2, 1, 3), pieces=4)
    return tmp_path / "episodes"


def expected():
    """The episodes by the order of their ends: env and first step."""
    rollout_ET = rollout_of(3, 12)
    # Env 2 ends at steps 1, 3, 5; env 0 at 2, 5; env 1 at 4.
    spans = ((2, 0, 2), (0, 0, 3), (2, 2, 4), (1, 0, 5), (0, 3, 6), (2, 4, 6))
    return torch.cat([rollout_ET[env, start:stop] for env, start, stop in spans]), [
        stop - start for _, start, stop in spans
    ]


def test_whole_episodes_come_back_in_the_order_of_their_ends(folder):
    found = data.read_episodes(folder)
    rows, lengths = expected()
    episode_D = torch.repeat_interleave(torch.arange(6), torch.tensor(lengths))
    assert found.env_states_D.names == ["D"]
    assert found.env_states_D["next"].names == ["D"]
    assert torch.equal(found.env_states_D["episode"], episode_D)
    assert (found.env_states_D.exclude("episode") == rows).all()
    assert (found.contents.num_episodes, found.contents.num_env_states) == (6, 17)
    assert found.contents.origin == Origin(task="made_up", step_dt=0.02)
    by_key = {leaf.key: leaf.dims for leaf in found.contents.leaves}
    assert by_key["rgb",] == "DHWC" and by_key["next", "obs", "x"] == "DL"


def test_tensordict_and_torchrl_read_it_without_this_library(folder):
    rows, _ = expected()
    loaded = TensorDict.load_memmap(folder / "env_states", allow_pickle=False)
    assert (loaded.exclude("episode") == rows).all()
    sampler = SliceSampler(num_slices=4, traj_key="episode", strict_length=False)
    buffer = ReplayBuffer(storage=TensorStorage(loaded), sampler=sampler, batch_size=8)
    assert "action" in buffer.sample()


@pytest.mark.parametrize(
    "sampler",
    [
        data.EpochSampler(seed=1),
        data.PrioritySampler(17),
        RandomSampler(),
        SamplerWithoutReplacement(),
        SliceSampler(slice_len=2, traj_key="episode"),
    ],
    ids=lambda sampler: type(sampler).__name__,
)
def test_samplers_of_one_dim_draw_from_it(folder, sampler):
    rows = expected()[0]
    buffer = data.load(folder, sampler=sampler, batch_size=4)
    sample = buffer.sample()
    assert sample.shape == (4,)
    # Each drawn row is a stored one, with all its leaves.
    for row in sample.exclude("episode", "index", "priority_weight"):
        same = (rows.get("action") == row.get("action")).flatten()
        assert same.sum() == 1
        stored = rows[same][0]
        assert all(torch.equal(row[key], stored[key]) for key in stored.keys(True, True))
    if isinstance(buffer.sampler, data.EpochSampler | SamplerWithoutReplacement):
        drawn = torch.cat([sample["action"], *(buffer.sample()["action"] for _ in range(3))])
        assert len(drawn.unique()) == 16


def test_a_rollout_that_begins_within_episodes_gives_later_ones(tmp_path):
    record(tmp_path / "episodes", rollout_of(2, 12), (1, 1), starts_within=True)
    found = data.read_episodes(tmp_path / "episodes").env_states_D
    assert found["obs", "step"].flatten().tolist() == [3, 4, 5, 5, 6, 7, 8, 9]


def test_episodes_before_a_restart_of_all_envs_are_left_out(tmp_path):
    rollout_ET = rollout_of(1, 12)
    writer = EpisodeWriter(tmp_path / "episodes", leaves_of(rollout_ET), origin=Origin())
    with EpisodeRecorder(writer, episodes_E=(4,), max_length=5) as recorder:
        recorder.record(rollout_ET[:, :4])
        recorder.record(rollout_ET[:, 6:10], restarted=True)
    found = data.read_episodes(tmp_path / "episodes").env_states_D
    assert found["obs", "step"].flatten().tolist() == [0, 1, 2, 6, 7, 8]


def test_a_rollout_of_one_step_after_longer_ones_is_one_step(tmp_path):
    rollout_ET = rollout_of(1, 12)
    writer = EpisodeWriter(tmp_path / "episodes", leaves_of(rollout_ET), origin=Origin())
    recorder = EpisodeRecorder(writer, episodes_E=(4,), max_length=5)
    for first, last in ((0, 4), (4, 7), (7, 8), (8, 9), (9, 12)):
        recorder.record(rollout_ET[:, first:last])
    recorder.close()
    found = data.read_episodes(tmp_path / "episodes").env_states_D
    assert found["obs", "step"].flatten().tolist() == list(range(12))
    for _ in range(3):
        with pytest.raises(ValueError, match="closed"):
            recorder.record(rollout_ET)


def test_the_recorder_says_when_all_episodes_are_written(tmp_path):
    assert record(tmp_path / "a", rollout_of(2, 6), (2, 1)).is_done
    assert not record(tmp_path / "b", rollout_of(2, 6), (2, 2)).is_done


def test_a_change_of_the_numbers_stays_in_memory(folder):
    found = data.read_episodes(folder).env_states_D
    before = (folder / "env_states" / "action.memmap").read_bytes()
    found["action"].zero_()
    assert (folder / "env_states" / "action.memmap").read_bytes() == before
    with pytest.raises(RuntimeError):
        data.load(folder).extend(found[:2])


def test_episodes_of_an_env_are_those_that_it_tells_of(tmp_path):
    env = CounterEnv(lengths=(3, 5, 4))
    rollout_ET = env.rollout(30, break_when_any_done=False)
    kept_ET = rollout_ET.select("count", "row", "episode_E", "action", "next", strict=False)
    writer = EpisodeWriter(tmp_path / "episodes", leaves_of(kept_ET), origin=Origin())
    with EpisodeRecorder(writer, episodes_E=(2, 2, 2), max_length=5) as recorder:
        recorder.record(kept_ET)
    found = data.read_episodes(tmp_path / "episodes").env_states_D
    lengths = []
    for number in range(6):
        episode_T = found[found["episode"] == number]
        length = (3, 5, 4)[int(episode_T["row"][0])]
        lengths.append(length)
        assert episode_T["count"].flatten().tolist() == list(range(length))
        assert episode_T["next", "count"].flatten().tolist() == list(range(1, length + 1))
        assert torch.allclose(episode_T["next", "reward"], episode_T["action"].sum(-1, True))
        assert episode_T["next", "done"].flatten().tolist() == [False] * (length - 1) + [True]
    assert sorted(lengths) == [3, 3, 4, 4, 5, 5]


def test_an_episode_longer_than_the_env_says_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="more than 5 env states"):
        record(tmp_path / "episodes", rollout_of(1, 12).apply(torch.zeros_like), (1,))


def test_a_commit_that_is_cut_anywhere_leaves_whole_episodes(tmp_path, monkeypatch):
    """The process may end before any of the files that a commit renews."""
    leaves = leaves_of(rollout_of(1, 3))
    rows = rollout_of(1, 6)[0]
    writes = writing.write_whole
    cut = 0
    while True:
        folder = tmp_path / str(cut)
        writer = EpisodeWriter(folder, leaves, origin=Origin())
        numbers = {leaf.key: rows.get(leaf.key).numpy() for leaf in leaves}
        writer.append({key: value[:3] for key, value in numbers.items()})
        writer.commit()
        writer.append({key: value[3:] for key, value in numbers.items()})
        left = [cut]

        def write_some(path, content, left=left):
            if left[0] == 0:
                raise KeyboardInterrupt
            left[0] -= 1
            writes(path, content)

        monkeypatch.setattr("ksim_rl.data.episode_folder.write_whole", write_some)
        try:
            writer.commit()
        except KeyboardInterrupt:
            size = 3
        else:
            size = 6
        monkeypatch.undo()
        own = data.read_episodes(folder)
        assert len(own.env_states_D) == size
        assert (own.env_states_D.exclude("episode") == rows[:size]).all()
        # TensorDict finds sizes of two commits, or rows that do not count yet, until they are mended.
        if 0 < cut < 4:
            with pytest.raises(RuntimeError, match="incompatible with the batch-size"):
                TensorDict.load_memmap(folder / "env_states", allow_pickle=False)
        data.mend(folder)
        alone = TensorDict.load_memmap(folder / "env_states", allow_pickle=False)
        assert len(alone) == size
        assert (alone.exclude("episode") == rows[:size]).all()
        if size == 6:
            break
        cut += 1
    assert cut == 5  # next/obs, next, obs, the outer one, episodes.json


def damaged(folder, **changes):
    path = folder / "episodes.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def shorten(folder):
    path = folder / "env_states" / "next" / "reward.memmap"
    os.truncate(path, path.stat().st_size - 1)


def lead_out(folder):
    leaves = json.loads((folder / "episodes.json").read_text())["leaves"]
    leaves[0]["key"] = ["..", "..", "secret"]
    damaged(folder, leaves=leaves)


def changed_leaf(folder, name, **changes):
    leaves = json.loads((folder / "episodes.json").read_text())["leaves"]
    for leaf in leaves:
        if leaf["key"] == [name]:
            leaf.update(changes)
    damaged(folder, leaves=leaves)


def misplaced(folder, start, stop):
    origin = json.loads((folder / "episodes.json").read_text())["origin"]
    origin["columns"] = {"action": {"torque": [start, stop]}}
    damaged(folder, origin=origin)


def link(folder):
    path = folder / "env_states" / "action.memmap"
    shutil.move(path, folder / "elsewhere")
    path.symlink_to(folder / "elsewhere")


def pipe(folder):
    (folder / "env_states" / "action.memmap").unlink()
    os.mkfifo(folder / "env_states" / "action.memmap")


def renumber(folder):
    path = folder / "env_states" / "episode.memmap"
    np.full(17, 7, dtype=np.int64).tofile(path)


def reorder(folder):
    """The first and the last are as they were."""
    path = folder / "env_states" / "episode.memmap"
    number_D = np.fromfile(path, dtype=np.int64)
    number_D[5] = 2**62
    number_D.tofile(path)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (shorten, "reward.memmap: damaged: 67 bytes, and 17 env states need 68"),
        (lead_out, "'..' cannot be the name of a file"),
        (link, "action.memmap: cannot be read"),
        (pipe, "action.memmap: cannot be read: it is no regular file"),
        (renumber, "not of episodes 0 to 5"),
        (reorder, "not of episodes 0 to 5, one after the other"),
        (lambda folder: changed_leaf(folder, "episode", dtype="float64"), "one int64"),
        (lambda folder: changed_leaf(folder, "action", shape=[0]), "no number in it"),
        (lambda folder: changed_leaf(folder, "action", key="action"), "a list of names"),
        (lambda folder: misplaced(folder, 0, 10**12), "in 0 to 1000000000000, and there are 1"),
        (lambda folder: misplaced(folder, -1, 1), "in -1 to 1, and there are 1"),
        (lambda folder: damaged(folder, format=2), "format 2, and this version reads 1"),
        (lambda folder: damaged(folder, num_env_states=-1), "num_env_states=-1"),
        (lambda folder: damaged(folder, num_env_states=2**40), "damaged"),
        (lambda folder: damaged(folder, extra=1), "extra"),
        (lambda folder: damaged(folder, leaves=[]), "leaves"),
        (lambda folder: (folder / "episodes.json").unlink(), "missing"),
    ],
)
def test_what_is_damaged_or_leads_out_is_refused_by_name(folder, damage, message):
    damage(folder)
    with pytest.raises(ValueError, match=message) as refused:
        data.load(folder)
    assert str(folder) in str(refused.value)
    with pytest.raises(ValueError, match=str(folder)):
        data.mend(folder)


def test_a_foreign_truth_is_zero_or_one(folder):
    path = folder / "env_states" / "next" / "done.memmap"
    path.write_bytes(bytes([7] * 17))
    assert data.read_episodes(folder).env_states_D["next", "done"].sum() == 17


def test_a_folder_that_holds_something_is_refused(folder):
    leaves = [Leaf(key=("action",))]
    with pytest.raises(ValueError, match="action.memmap: it is there already"):
        EpisodeWriter(folder, leaves, origin=Origin())


def test_an_error_of_the_disk_reaches_the_caller(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(EpisodeWriter, "append", fail)
    with pytest.raises(OSError, match="No space left"):
        record(tmp_path / "episodes", rollout_of(2, 12), (4, 2), pieces=4)


def test_a_file_that_cannot_grow_is_an_error_that_names_the_folder(tmp_path):
    folder = tmp_path / "episodes"
    writer = EpisodeWriter(folder, [Leaf(key=("x",)), Leaf(key=("y",))], origin=Origin())
    rows = np.zeros(1000, dtype=np.float32)
    writer.append({("x",): rows, ("y",): rows})
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        with pytest.raises(OSError, match=str(folder)):
            writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    with pytest.raises(ValueError, match="no whole episode"):
        data.read_episodes(folder)


@pytest.mark.parametrize(
    ("key", "message"), [((), "at least one"), (("a/b",), "a/b"), (("..",), "'..'"), (("",), "''")]
)
def test_names_that_are_no_names_of_files_are_refused(key, message):
    with pytest.raises(ValueError, match=message):
        Leaf(key=key)


def test_more_env_states_than_32_bits_count():
    # So many are an hour of a fast env.
    made = [Leaf(key=("episode",), dtype="int64")]
    assert Contents(leaves=tuple(made), origin=Origin(), num_env_states=2**40).num_env_states


def test_types_that_other_programs_do_not_know_are_refused():
    rollout = TensorDict({"x": torch.zeros(2, 3, 1, dtype=torch.bfloat16)}, batch_size=[2, 3])
    with pytest.raises(ValueError, match="dtype='bfloat16' of x: expected one of bool"):
        leaves_of(rollout)


def numbers_of(episode):
    """The numbers of an episode, which follow from its number: its length, too."""
    length = 1 + episode % 7
    return np.full((length, 3), episode, dtype=np.float32), np.arange(length)


def write_until_killed(folder, pipe):
    """Run in a fork: write episode after episode, and report each commit."""
    leaves = [Leaf(key=("obs", "x"), shape=(3,)), Leaf(key=("step",), dtype="int64")]
    writer = EpisodeWriter(folder, leaves, origin=Origin())
    for episode in range(10**9):
        x, step = numbers_of(episode)
        writer.append({("obs", "x"): x, ("step",): step})
        if episode % 3 == 2:
            writer.commit()
            os.write(pipe, f"{episode + 1}\n".encode())


@pytest.mark.parametrize("times", [2, pytest.param(200, marks=pytest.mark.full)])
def test_a_recording_that_is_killed_keeps_all_episodes_that_were_committed(tmp_path, times):
    choose = random.Random(times)
    for number in range(times):
        folder = tmp_path / str(number)
        reading, writing_end = os.pipe()
        child = os.fork()
        if child == 0:
            try:
                write_until_killed(folder, writing_end)
            finally:
                os._exit(1)
        os.close(writing_end)
        reported = os.read(reading, 10)
        time.sleep(choose.uniform(0.0, 0.03))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        while more := os.read(reading, 4096):
            reported += more
        os.close(reading)

        found = data.read_episodes(folder)
        assert found.contents.num_episodes >= int(reported.split()[-1])
        expected_numbers = [numbers_of(number) for number in range(found.contents.num_episodes)]
        x_D3, step_D = map(np.concatenate, zip(*expected_numbers, strict=True))
        assert np.array_equal(found.env_states_D["obs", "x"].numpy(), x_D3)
        assert np.array_equal(found.env_states_D["step"].numpy(), step_D)
        data.mend(folder)
        alone = TensorDict.load_memmap(folder / "env_states", allow_pickle=False)
        assert (alone == found.env_states_D).all()
