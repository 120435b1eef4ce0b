import json
import sys
from pathlib import Path

import pytest
import torch

from benchmarks import peers


def main(monkeypatch, *words: str) -> None:
    monkeypatch.setattr(sys, "argv", ["benchmark", *words])
    peers.main()


def test_without_a_peer_it_says_so_and_ends_well(monkeypatch, capsys):
    for words in ((), ("--python", "no_such_python", "task=go1_velocity_flat")):
        main(monkeypatch, *words)
        assert capsys.readouterr().out.splitlines() == [
            "no peer: give --python the interpreter of an environment with mjlab and rsl_rl"
        ]


def test_a_misspelt_word_is_refused_even_without_a_peer(monkeypatch):
    with pytest.raises(ValueError, match="did you mean 'num_envs'"):
        main(monkeypatch, "num_env=4")
    with pytest.raises(SystemExit) as ended:
        main(monkeypatch, "--pyton", "x")
    assert ended.value.code == 2
    with pytest.raises(ValueError, match="at least 4"):
        main(monkeypatch, "--iterations", "1")


@pytest.mark.parametrize(
    ("device", "visible", "expected"),
    [
        ("cpu", None, ""),
        ("cuda", None, "0"),
        ("cuda:1", None, "1"),
        ("cuda", "3,5", "3"),
        ("cuda:1", "3,5", "5"),
    ],
)
def test_the_peer_runs_on_our_device(monkeypatch, device, visible, expected):
    seen = {}

    def run(command, *, env, **kwargs):
        seen.update(env)
        (Path(command[-1]) / "peer.json").write_text(json.dumps({"env_states_per_s": 2.0}))

    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if visible is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    monkeypatch.setattr(peers.subprocess, "run", run)
    rate = peers.peer_rate(
        "python", "go1_velocity_flat", num_envs=2, iterations=4, device=torch.device(device)
    )
    assert rate == {"env_states_per_s": 2.0}
    assert seen["CUDA_VISIBLE_DEVICES"] == expected
