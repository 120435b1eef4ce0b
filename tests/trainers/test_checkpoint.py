"""Checkpoints: any damage is refused with the reason, a crash loses nothing, nothing in them can execute."""

import io
import json
import os
import pickle
import random
import shutil
import signal
import time
import zipfile

import pytest
import torch

from ksim_rl.trainers import checkpoint, checkpoint_formats
from ksim_rl.trainers.checkpoint import MANIFEST, TENSORS, CheckpointError

STATE = {
    "update": {"actor": {"weight": torch.arange(6.0).reshape(2, 3), "empty": torch.zeros(0, 4)}},
    "env": {
        "world.qpos": torch.rand(4, 3),
        "flags": torch.tensor([True, False]),
        "metric/a~b": torch.tensor(7),
    },
    "sampler": {"seed": 3, "epoch": 12},
    "none": {},
    "note": "x",
}
CONFIG = {"task_name": "probe", "num_envs": 4}


@pytest.fixture
def saved(tmp_path):
    return checkpoint.save(tmp_path / "checkpoint", STATE, iteration=20, config=CONFIG)


def test_what_is_loaded_is_what_was_saved(saved):
    loaded = checkpoint.load(saved)
    assert (loaded.iteration, loaded.config) == (20, CONFIG)
    assert loaded.state.keys() == STATE.keys()
    assert loaded.state["sampler"] == STATE["sampler"]
    assert loaded.state["none"] == {}
    assert loaded.state["env"].keys() == STATE["env"].keys()
    for name, tensor in STATE["env"].items():
        assert loaded.state["env"][name].dtype == tensor.dtype
        assert torch.equal(loaded.state["env"][name], tensor)
    assert loaded.state["update"]["actor"]["empty"].shape == (0, 4)


def test_only_the_newest_stay_and_no_other_file_is_left(tmp_path):
    for iteration in (5, 10, 15, 20):
        checkpoint.save(tmp_path, STATE, iteration=iteration, config=CONFIG, keep=2)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["00000015", "00000020"]
    assert sorted(entry.name for entry in (tmp_path / "00000020").iterdir()) == [MANIFEST, TENSORS]


def test_the_newest_one_that_is_trusted_stays_as_well(tmp_path):
    for iteration, trusted in ((5, 5), (10, 5), (15, 12), (20, 12), (25, 12)):
        checkpoint.save(
            tmp_path, STATE, iteration=iteration, config=CONFIG, keep=2, trusted=trusted
        )
    assert [entry.name for entry in checkpoint.saved(tmp_path)] == [
        "00000010",
        "00000020",
        "00000025",
    ]
    checkpoint.save(tmp_path, STATE, iteration=30, config=CONFIG, keep=2, trusted=30)
    assert [entry.name for entry in checkpoint.saved(tmp_path)] == ["00000025", "00000030"]
    assert checkpoint.newest_until(tmp_path, 29) == tmp_path / "00000025"
    assert checkpoint.newest_until(tmp_path, 24) is None


def test_saving_the_same_iteration_again_keeps_both_until_one_is_old(tmp_path):
    first = checkpoint.save(tmp_path, STATE, iteration=5, config=CONFIG)
    second = checkpoint.save(tmp_path, STATE, iteration=5, config=CONFIG)
    assert first != second
    assert checkpoint.load_latest(tmp_path).path == second


@pytest.mark.parametrize("given", ["run folder", "checkpoint folder", "checkpoint"])
def test_the_newest_is_found_from_each_level(tmp_path, saved, given):
    checkpoint.save(tmp_path / "checkpoint", STATE, iteration=3, config=CONFIG)
    path = {
        "run folder": tmp_path,
        "checkpoint folder": tmp_path / "checkpoint",
        "checkpoint": saved,
    }[given]
    assert checkpoint.load_latest(path).path == saved


def test_a_folder_without_a_checkpoint_says_what_was_expected(tmp_path):
    with pytest.raises(CheckpointError, match="no checkpoint here; expected a run folder"):
        checkpoint.load_latest(tmp_path)


def flip_bytes(saved, count, seed):
    """Yield one damaged copy after the other: a flipped bit, a cut, an insertion or a swap, anywhere."""
    choose = random.Random(seed)
    for number in range(count):
        copy = saved.parent.parent / f"damaged{number}"
        shutil.copytree(saved, copy)
        path = copy / choose.choice([MANIFEST, TENSORS])
        content = bytearray(path.read_bytes())
        at = choose.randrange(len(content))
        kind = choose.choice(["flip", "flip", "cut", "insert", "swap"])
        if kind == "flip":
            content[at] ^= 1 << choose.randrange(8)
        elif kind == "cut":
            del content[at:]
        elif kind == "insert":
            content.insert(at, choose.randrange(256))
        else:
            other = (at + 1 + choose.randrange(len(content) - 1)) % len(content)
            content[at], content[other] = content[other], content[at]
            if content == path.read_bytes():
                content[at] ^= 255
        path.write_bytes(bytes(content))
        yield copy
        shutil.rmtree(copy)


def assert_all_refused(saved, count, seed):
    for damaged in flip_bytes(saved, count, seed):
        with pytest.raises(CheckpointError, match=r"damaged|format|manifest|not a valid"):
            checkpoint.load(damaged)


def test_random_damage_is_refused(saved):
    assert_all_refused(saved, 100, seed=0)


@pytest.mark.full
def test_random_damage_is_refused_1000_times(saved):
    assert_all_refused(saved, 1000, seed=1)


def damage_missing_tensors(path):
    (path / TENSORS).unlink()


def damage_missing_manifest(path):
    (path / MANIFEST).unlink()


def damage_extra_file(path):
    (path / "extra.pt").write_bytes(b"x")


def damage_link(path):
    target = path.parent.parent / "elsewhere"
    shutil.move(path / TENSORS, target)
    (path / TENSORS).symlink_to(target)


def damage_fifo(path):
    (path / TENSORS).unlink()
    os.mkfifo(path / TENSORS)


def damage_longer(path):
    with open(path / TENSORS, "ab") as file:
        file.write(b"\0")


def damage_empty(path):
    (path / TENSORS).write_bytes(b"")


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (damage_missing_tensors, "tensors.safetensors: missing"),
        (damage_missing_manifest, "manifest.json: missing"),
        (damage_extra_file, "unexpected file 'extra.pt'"),
        (damage_link, "cannot be read"),
        (damage_fifo, "cannot be read: it is no regular file"),
        (damage_longer, "longer than the"),
        (damage_empty, "damaged: 0 bytes, the manifest says"),
    ],
)
def test_each_kind_of_damage_is_named(saved, damage, reason):
    damage(saved)
    with pytest.raises(CheckpointError, match=reason):
        checkpoint.load(saved)


def with_version(saved, version):
    """Write the manifest as a program of another version would: its own number, and a seal that is right."""
    manifest = json.loads((saved / MANIFEST).read_text())["manifest"] | {"format_version": version}
    (saved / MANIFEST).write_bytes(checkpoint._seal(manifest))
    return saved


@pytest.mark.parametrize(
    ("version", "reason"),
    [
        (checkpoint_formats.FORMAT_VERSION + 1, "load it with the newer ksim_rl that wrote it"),
        (0, "expected a whole number from 1"),
        (None, "expected a whole number from 1"),
        ("2", "expected a whole number from 1"),
        (True, "expected a whole number from 1"),
    ],
)
def test_a_format_that_cannot_be_read_is_refused_with_what_to_do(saved, version, reason):
    with pytest.raises(CheckpointError, match=reason):
        checkpoint.load(with_version(saved, version))


@pytest.mark.parametrize("field", ["iteration", "bytes"])
def test_a_truth_value_is_no_number_of_a_manifest(saved, field):
    manifest = json.loads((saved / MANIFEST).read_text())["manifest"]
    where = manifest if field == "iteration" else manifest["files"][checkpoint.TENSORS]
    where[field] = True
    (saved / MANIFEST).write_bytes(checkpoint._seal(manifest))
    with pytest.raises(
        CheckpointError, match="not a checkpoint manifest: a field is missing or of another type"
    ):
        checkpoint.load(saved)


def test_an_older_format_without_a_way_up_is_refused(saved, monkeypatch):
    monkeypatch.setattr(checkpoint_formats, "MIGRATIONS", {})
    with pytest.raises(
        CheckpointError, match="format 1, and there is no way from 1 to 2: load it with the version"
    ):
        checkpoint.load(with_version(saved, 1))


def test_the_config_keeps_its_order(tmp_path):
    config = {"task": {"observations": {"actor": {"terms": {"velocity": 1, "angle": 2}}}}}
    loaded = checkpoint.load(checkpoint.save(tmp_path, STATE, iteration=1, config=config))
    assert json.dumps(loaded.config) == json.dumps(config)


def test_a_checkpoint_of_version_1_gets_back_the_order_of_its_observations(tmp_path):
    """Version 1 sorted the config by name; the columns say how the terms stood."""
    columns = {
        "actor": {"actor_terms/velocity": [0, 3], "obs/angle": [5, 6], "obs/command": [3, 5]}
    }
    terms = {"angle": 2, "command": 3, "velocity": 1}
    config = {
        "task": {
            "observations": {"actor": {"keep": True, "terms": terms}, "plain": {"terms": terms}}
        }
    }
    saved = checkpoint.save(
        tmp_path, STATE | {"observation_columns": columns}, iteration=1, config=config
    )
    observations = checkpoint.load(with_version(saved, 1)).config["task"]["observations"]
    assert list(observations["actor"]["terms"].items()) == [
        ("velocity", 1),
        ("command", 3),
        ("angle", 2),
    ]
    assert observations["actor"]["keep"] is True
    assert list(observations["plain"]["terms"]) == ["angle", "command", "velocity"], (
        "nothing is known of it"
    )


def test_a_checkpoint_of_version_1_is_migrated(saved):
    """Version 1 is what ksim_rl wrote before hooks had a state."""
    loaded = checkpoint.load(with_version(saved, 1))
    assert loaded.state["hooks"] == loaded.state["update"]["recurrent_state"] == {}
    assert torch.equal(
        loaded.state["update"]["actor"]["weight"], STATE["update"]["actor"]["weight"]
    )
    assert loaded.state["sampler"] == STATE["sampler"]


class Bomb:
    """Writes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


def payloads(trace):
    """Files that execute code in loaders that unpickle."""
    bomb = pickle.dumps(Bomb(trace))
    yield "pickle", bomb
    buffer = io.BytesIO()
    torch.save(Bomb(trace), buffer)
    yield "torch.save", buffer.getvalue()
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("archive/data.pkl", bomb)
    yield "zip", archive.getvalue()
    yield "header", (2**62).to_bytes(8, "little") + b"{}"
    yield "nested", b"[" * 200_000
    yield (
        "target",
        json.dumps({"manifest": {"_target_": "os.system", "_args_": [f"touch {trace}"]}}).encode(),
    )


@pytest.mark.parametrize("file", [MANIFEST, TENSORS])
def test_a_malicious_file_executes_nothing(saved, file):
    trace = saved.parent / "executed"
    for _, content in payloads(trace):
        (saved / file).write_bytes(content)
        with pytest.raises(CheckpointError):
            checkpoint.load(saved)
    assert not trace.exists()


def test_a_sealed_malicious_tensor_file_executes_nothing(saved):
    trace = saved.parent / "executed"
    manifest = json.loads((saved / MANIFEST).read_bytes())["manifest"]
    for _, content in payloads(trace):
        (saved / TENSORS).write_bytes(content)
        manifest["files"][TENSORS] = {"bytes": len(content), "sha256": checkpoint._sha256(content)}
        (saved / MANIFEST).write_bytes(checkpoint._seal(manifest))
        with pytest.raises(CheckpointError, match="not a valid tensor file"):
            checkpoint.load(saved)
    assert not trace.exists()


def test_saving_and_loading_never_unpickle(saved, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("a pickle path was taken")

    for module, name in (
        (pickle, "load"),
        (pickle, "loads"),
        (pickle, "dumps"),
        (torch, "load"),
        (torch, "save"),
    ):
        monkeypatch.setattr(module, name, refuse)
    checkpoint.load(checkpoint.save(saved.parent, STATE, iteration=30, config=CONFIG))


def test_state_that_is_no_plain_data_is_refused_by_its_path(tmp_path):
    with pytest.raises(
        ValueError, match="state /env/term is a object: a checkpoint holds tensors and plain data"
    ):
        checkpoint.save(tmp_path, {"env": {"term": object()}}, iteration=1, config={})


def save_until_killed(folder, pipe):
    """Run in a fork: save one checkpoint after the other, and report each."""
    checkpoint.remove_leftovers(folder)
    found = checkpoint.saved(folder)
    iteration = checkpoint.load(found[-1]).iteration if found else 0
    while True:
        iteration += 1
        # Small enough for one thread: a fork has none of torch's others.
        state = {"weight": torch.full((20000,), float(iteration)), "iteration": iteration}
        checkpoint.save(folder, state, iteration=iteration, config={}, keep=2)
        os.write(pipe, f"{iteration}\n".encode())


def kill_while_saving(folder, times):
    choose = random.Random(times)
    for _ in range(times):
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            try:
                save_until_killed(folder, writing)
            finally:
                os._exit(1)
        os.close(writing)
        reported = os.read(reading, 10)
        time.sleep(choose.uniform(0.0, 0.03))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        while more := os.read(reading, 4096):
            reported += more
        os.close(reading)

        loaded = checkpoint.load_latest(folder)
        assert loaded.iteration >= int(reported.split()[-1])
        for path in checkpoint.saved(folder):
            intact = checkpoint.load(path)
            assert intact.state["iteration"] == intact.iteration
            assert torch.equal(
                intact.state["weight"], torch.full((20000,), float(intact.iteration))
            )
    checkpoint.remove_leftovers(folder)
    assert {entry.name for entry in folder.iterdir()} == {
        path.name for path in checkpoint.saved(folder)
    }
    assert len(checkpoint.saved(folder)) <= 3


def test_kill_while_saving_loses_nothing(tmp_path):
    kill_while_saving(tmp_path, 3)


@pytest.mark.full
def test_kill_while_saving_200_times_loses_nothing(tmp_path):
    kill_while_saving(tmp_path, 200)


def damage_emptied(path):
    for entry in path.iterdir():
        entry.unlink()


@pytest.mark.parametrize("damage", [damage_emptied, damage_empty, damage_missing_manifest])
def test_a_newest_checkpoint_that_is_damaged_is_passed_over_and_said(tmp_path, damage):
    older = checkpoint.save(tmp_path, STATE, iteration=6, config=CONFIG)
    damage(checkpoint.save(tmp_path, STATE, iteration=7, config=CONFIG))
    notes = []
    assert checkpoint.load_latest(tmp_path, note=notes.append).path == older
    assert len(notes) == 1 and "00000007" in notes[0] and "00000006 is taken instead" in notes[0]
    with pytest.warns(UserWarning, match="passed over"):
        checkpoint.load_latest(tmp_path)
    damage(older)
    with pytest.raises(CheckpointError, match="00000007"):
        checkpoint.load_latest(tmp_path)


def test_a_newest_checkpoint_of_an_unknown_format_is_not_passed_over(tmp_path):
    checkpoint.save(tmp_path, STATE, iteration=6, config=CONFIG)
    with_version(checkpoint.save(tmp_path, STATE, iteration=7, config=CONFIG), 99)
    with pytest.raises(CheckpointError, match="newer ksim_rl"):
        checkpoint.load_latest(tmp_path)


@pytest.mark.parametrize(
    "error", [KeyError("seed"), TypeError("no"), AttributeError("no"), IndexError("no")]
)
def test_a_state_of_another_kind_is_refused_with_its_checkpoint(tmp_path, error):
    with (
        pytest.raises(
            checkpoint.CheckpointError, match=f"{tmp_path}: it holds another state .*{error}"
        ),
        checkpoint.fitting(tmp_path),
    ):
        raise error
