"""Where memory does not suffice, the message says what an env takes and how many fit."""

import gc
import io
import json
import sys
import weakref

import mujoco_warp as mjw
import pytest
import torch

from ksim_rl import conf
from ksim_rl.algorithms.off_policy.update import OffPolicyUpdate
from ksim_rl.device import memory
from ksim_rl.device.memory import TooManyEnvsError, memory_for, refused_bytes
from ksim_rl.trainers import RunProgress, run_folder, trial
from tests.cli.payloads import SMALL
from tests.device.small_machine import hold_at_most
from tests.physics.models import standing_quadrupeds

CPU, CUDA = torch.device("cpu"), torch.device("cuda:0")


def test_refusals_are_told_from_other_errors():
    # A real one: no machine has the memory for it, and nothing of it is touched.
    with pytest.raises(RuntimeError) as refused:
        torch.empty(2**55, dtype=torch.uint8)
    assert refused_bytes(refused.value) == 2**55
    assert refused_bytes(RuntimeError("Failed to allocate 1024 bytes on device 'cuda:0'")) == 1024
    on_cuda = torch.OutOfMemoryError(
        "CUDA out of memory. Tried to allocate 2.50 GiB. GPU 0 has a total capacity"
    )
    assert refused_bytes(on_cuda) == 5 * 2**29
    assert refused_bytes(RuntimeError("shape mismatch")) is None


def test_the_number_that_fits_follows_from_what_was_taken(monkeypatch):
    free = iter((10_000_000_000, 4_000_000_000))
    monkeypatch.setattr(memory, "free_bytes", lambda device: next(free))
    # 6 GB were taken when 10 GB more were asked for, for 1000 envs: 16 MB each, of which 10 GB hold 625.
    said = r"num_envs=1000: .* 16,000,000 bytes of 10\.0 GB .*: at most 625 fit"
    with pytest.raises(ValueError, match=said), memory_for(1000, CUDA):
        raise RuntimeError("Failed to allocate 10000000000 bytes on device 'cuda:0'")


def test_what_was_built_is_given_back_before_fewer_are_tried():
    """Also what is held by the error that another one was raised from, as of a graph that cannot be recorded."""
    built = weakref.WeakSet()

    def body():
        array = torch.zeros(3)
        built.add(array)
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 1.00 KiB")

    def record():
        try:
            body()
        except RuntimeError as error:
            raise RuntimeError(f"the body cannot be captured: {error}") from error

    def first_that_fits(numbers):
        assert not built
        tried.extend(numbers)
        return 80

    tried = []
    with (
        pytest.raises(ValueError, match=r"num_envs=380: .*; num_envs=80 was tried and fits\."),
        memory_for(380, CPU, first_that_fits),
    ):
        record()
    assert tried == [190, 95, 47, 23, 11, 5, 2, 1]


def test_numbers_that_cannot_fit_are_not_tried(monkeypatch):
    """The nearest to what failed knows best what an env takes: further out it may be given back already."""

    def first_that_fits(numbers):
        tried.extend(numbers)

    tried = []
    monkeypatch.setattr(memory, "free_bytes", lambda device: 100)
    with (
        pytest.raises(TooManyEnvsError, match=r"at least 10 bytes .* at most 10 fit\. ") as told,
        memory_for(50, CPU, first_that_fits),
        memory_for(50, CPU),
    ):
        raise RuntimeError("Failed to allocate 500 bytes on device 'cuda:0'")
    assert tried == [6, 3, 1] and "was tried" not in str(told.value)


def test_other_errors_pass():
    with pytest.raises(RuntimeError, match="^shape mismatch$"), memory_for(4, CPU):
        raise RuntimeError("shape mismatch")


def test_a_world_that_does_not_fit_says_so(monkeypatch):
    def refuse(*args, **kwargs):
        raise RuntimeError("Failed to allocate 4000 bytes on device 'cpu'")

    monkeypatch.setattr(mjw, "make_data", refuse)
    with pytest.raises(
        ValueError, match=r"num_envs=4: out of memory on cpu; one env takes at least 1,000 bytes"
    ):
        standing_quadrupeds(4)


@pytest.mark.full
@pytest.mark.parametrize(
    ("room", "fits"),
    # With 16 envs Warp's arrays take 66,027 bytes, with 8 of them 34,787; a tenth of the room has to be left.
    [(80_000, 16), (71_000, 8)],
)
def test_a_run_whose_envs_do_not_fit_names_a_number_that_trained_elsewhere(
    tmp_path, monkeypatch, room, fits
):
    smaller = f"from tests.device.small_machine import hold_at_most; hold_at_most({room}); "
    monkeypatch.setattr(trial, "PROGRAM", smaller + trial.PROGRAM)

    def note(line):
        said.append(line)
        assert sum(held.values()) < 1000, "what was built is given back before anything is tried"

    said = []
    progress = RunProgress(1, enabled=False)
    monkeypatch.setattr(progress, "note", note)
    cfg = conf.compose([*SMALL, "num_envs=32", "trainer.eval_episodes=0"])
    gc.collect()
    held = hold_at_most(room, monkeypatch.setattr)
    with pytest.raises(
        ValueError, match=rf"num_envs=32: out of memory .*; num_envs={fits} was tried and fits"
    ):
        run_folder.run(cfg, tmp_path / "run", progress=progress)
    assert said[-1] == f"memory does not suffice: trying num_envs={fits}"
    if fits == 8:
        assert "num_envs=16 does not train: 0.00 of 0.00 GB are left, fewer than a tenth" in said
    assert not (tmp_path / "run").exists()


def test_a_trial_learns_thrice_however_late_the_run_does(monkeypatch):
    """A third update records the graph: without it, what the learning takes was not tried."""
    made = []
    for name in ("_store", "_update"):
        monkeypatch.setattr(OffPolicyUpdate, name, lambda self, name=name: made.append(name))
    cfg = conf.compose(["objective=sac", "num_envs=4", "device=cpu", "trainer.eval_episodes=0"])
    assert cfg.data.learning_starts == 100
    monkeypatch.setattr(sys, "stdin", io.StringIO(json.dumps(cfg.to_tree())))
    assert trial.main() == trial.FITS
    assert made == ["_store"] * 3 + ["_update"] * 5


@pytest.mark.full
def test_a_config_that_another_process_cannot_build_is_tried_once(monkeypatch):
    said = []
    cfg = conf.compose([*SMALL, "num_envs=8"])
    monkeypatch.setattr(type(cfg), "to_tree", lambda self: {"task_name": "?"})
    assert trial.first_that_fits(cfg, (4, 2, 1), note=said.append) is None
    assert len(said) == 2 and said[1].startswith("num_envs=4 does not train: ValueError: ")
