"""Ranks that do not fit together are refused in one line."""

import socket
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import torch.distributed as dist

from ksim_rl import conf, ranks
from ksim_rl.algorithms.ppo import PPO
from ksim_rl.ranks import start, store
from ksim_rl.trainers import build
from tests.ranks.gloo import results
from tests.ranks.test_agreement import SMALL


def test_a_process_alone_joins_nobody(monkeypatch):
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    with ranks.joined("train"):
        assert (ranks.rank(), ranks.size(), ranks.first_row(8), ranks.device("cuda")) == (
            0,
            1,
            0,
            "cuda",
        )
    assert ranks.by_first(lambda: "here") == "here"


@pytest.mark.parametrize(
    ("command", "variables", "message"),
    [
        ("eval", {}, "eval is for one process"),
        ("train", {}, "RANK is not: start the ranks by torchrun"),
        (
            "train",
            {"RANK": "0", "LOCAL_RANK": "0", "MASTER_ADDR": "localhost"},
            "MASTER_PORT is not",
        ),
    ],
)
def test_what_torchrun_did_not_start_is_refused(command, variables, message, monkeypatch):
    for name in ("RANK", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    for name, value in {"WORLD_SIZE": "2", **variables}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ValueError, match=message), ranks.joined(command):
        pass


def launch(monkeypatch, **variables):
    """Set what a launcher sets for rank 0 of 2, or other values."""
    own = {
        "RANK": "0",
        "LOCAL_RANK": "0",
        "WORLD_SIZE": "2",
        "MASTER_ADDR": "localhost",
        "MASTER_PORT": "1",
    }
    for name, value in {**own, **variables}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("TORCHELASTIC_USE_AGENT_STORE", raising=False)


def test_a_port_in_use_is_said_where_rank_0_serves_the_store(monkeypatch):
    with socket.socket() as other:
        other.bind(("", 0))
        other.listen()
        port = other.getsockname()[1]
        launch(monkeypatch, MASTER_PORT=str(port))
        with (
            pytest.raises(
                ValueError, match=f"MASTER_PORT={port} is in use on localhost: choose another one"
            ),
            ranks.joined("train"),
        ):
            pass


@pytest.mark.parametrize(
    ("local", "message"),
    [("0", "this torch has no NCCL"), ("2", "rank 2 has no GPU of its own: this machine has 2")],
)
def test_gpus_without_nccl_and_ranks_without_a_gpu_are_refused(local, message, monkeypatch):
    launch(monkeypatch, RANK=local, LOCAL_RANK=local, WORLD_SIZE="3")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.distributed, "is_nccl_available", lambda: False)
    with pytest.raises(ValueError, match=message), ranks.joined("train"):
        pass


def sharing(*uuids):
    torch.cuda.current_device = lambda: 0
    torch.cuda.get_device_properties = lambda _: SimpleNamespace(uuid=uuids[ranks.rank()])
    try:
        start.check_gpus("cpu:gloo,cuda:nccl")
    except ValueError as error:
        return str(error)
    return "nothing"


def test_two_ranks_on_one_gpu_are_refused_on_both(tmp_path):
    texts = results(sharing, "GPU-a", "GPU-a", size=2, folder=tmp_path / "one")
    assert all(
        text.startswith("ranks 0 and 1 share one GPU (") and "GPU-a" in text for text in texts
    )
    assert results(sharing, "GPU-a", "GPU-b", size=2, folder=tmp_path / "two") == [
        "nothing",
        "nothing",
    ]


def test_what_dead_processes_left_in_the_store_is_no_answer():
    """As torchrun does it: the store stays, and ranks of another attempt ask it."""
    run = dist.HashStore()

    def numbers():
        with ThreadPoolExecutor(3) as pool:
            return list(pool.map(lambda rank: store.attempt(run, rank=rank, size=3), range(3)))

    assert numbers() == [1, 1, 1]
    assert numbers() == [2, 2, 2]
    run.set("asks/1", "a rank that was killed before it had an answer")
    run.add("attempts", 1)
    assert numbers() == [4, 4, 4]


def said(values_of_second):
    """Return what is said where rank 1 has other values than rank 0."""
    values = {"seed": 1, "task": {"dt": 0.01}}
    try:
        ranks.check_same(values_of_second if ranks.rank() else values, what="config")
    except ValueError as error:
        return str(error)
    return "nothing"


def fails():
    if ranks.rank():
        return ranks.by_first(lambda: "never")
    try:
        ranks.by_first(lambda: Path("/nowhere/at/all").read_text())
    except OSError as error:
        return str(error)


def one_error():
    try:
        return fails()
    except OSError as error:
        return str(error)


def everything():
    refused = ""
    object.__setattr__(PPO, "on_ranks", False)  # as of an algorithm that knows nothing of ranks
    try:
        build(conf.compose(SMALL))
    except ValueError as error:
        refused = str(error)
    others = [
        {"seed": 2, "task": {"dt": 0.01}},
        {"seed": 1, "task": {}},
        {"seed": 1, "task": {"dt": 0.01}},
    ]
    return (
        [said(values) for values in others],
        one_error(),
        ranks.by_first(lambda: f"of {ranks.rank()}"),
        refused,
    )


def test_ranks_with_other_configs_are_refused_on_all_of_them(tmp_path):
    for texts, error, first, refused in results(everything, size=2, folder=tmp_path):
        assert texts[0].startswith(
            "rank 1 has another config: seed is 2 there and 1 on rank 0; start"
        )
        assert "task.dt is nothing there and 0.01 on rank 0" in texts[1]
        assert texts[2] == "nothing"
        assert "/nowhere/at/all" in error, "what rank 0 cannot write fails on all"
        assert first == "of 0"
        assert refused == "objective=ppo trains on one rank only: start it without torchrun"
