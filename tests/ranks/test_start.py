"""Ranks that do not fit together are refused in one line."""

from pathlib import Path

import pytest

from ksim_rl import conf, ranks
from ksim_rl.algorithms.ppo import PPO
from ksim_rl.trainers import build
from tests.ranks.gloo import results
from tests.ranks.test_agreement import SMALL


def test_a_process_alone_joins_nobody(monkeypatch):
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    with ranks.joined("train"):
        assert (ranks.rank(), ranks.size(), ranks.first_row(8), ranks.device("cuda")) == (0, 1, 0, "cuda")
    assert ranks.from_first("here") == "here"


@pytest.mark.parametrize(
    ("command", "variables", "message"),
    [
        ("eval", {}, "eval is for one process"),
        ("train", {}, "RANK is not: start the ranks by torchrun"),
        ("train", {"RANK": "0", "LOCAL_RANK": "0", "MASTER_ADDR": "localhost"}, "MASTER_PORT is not"),
    ],
)
def test_what_torchrun_did_not_start_is_refused(command, variables, message, monkeypatch):
    for name in ("RANK", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    for name, value in {"WORLD_SIZE": "2", **variables}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ValueError, match=message), ranks.joined(command):
        pass


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
    others = [{"seed": 2, "task": {"dt": 0.01}}, {"seed": 1, "task": {}}, {"seed": 1, "task": {"dt": 0.01}}]
    return [said(values) for values in others], one_error(), ranks.from_first(f"of {ranks.rank()}"), refused


def test_ranks_with_other_configs_are_refused_on_all_of_them(tmp_path):
    for texts, error, first, refused in results(everything, size=2, folder=tmp_path):
        assert texts[0].startswith("rank 1 has another config: seed is 2 there and 1 on rank 0; start")
        assert "task.dt is nothing there and 0.01 on rank 0" in texts[1]
        assert texts[2] == "nothing"
        assert "/nowhere/at/all" in error, "what rank 0 cannot write fails on all"
        assert first == "of 0"
        assert refused == "objective=ppo trains on one rank only: start it without torchrun"
