"""`ksim-rl card` refuses in one line, and writes page, picture and numbers."""

import json

import pytest

from ksim_rl.cli.main import main
from ksim_rl.transfer import command
from ksim_rl.transfer.conditions import CONDITIONS
from ksim_rl.zoo.cards import FOLDER


def run(capsys, *words):
    with pytest.raises(SystemExit) as stopped:
        main(["card", *map(str, words)])
    return stopped.value.code, capsys.readouterr()


def test_what_is_no_run_is_one_line(tmp_path, capsys):
    code, output = run(capsys, tmp_path / "none")
    assert code == 2 and output.err.count("\n") == 1
    code, output = run(capsys, "zoo:cartpole", "--episodes", 0)
    assert code == 2 and "--episodes=0" in output.err


@pytest.mark.full
def test_a_card_is_written(tmp_path, monkeypatch, capsys):
    # Three conditions are enough for the way through; that all are there is the card's own check.
    few = (CONDITIONS[0], CONDITIONS[1], CONDITIONS[-1])
    monkeypatch.setattr(command, "CONDITIONS", few)
    monkeypatch.setattr("ksim_rl.transfer.card.CONDITIONS", few)
    code, output = run(capsys, FOLDER / "cartpole", "--episodes", 2, "--output", tmp_path / "card")
    assert code in (0, 1) and "cannot apply: its ground is no plane" in output.out
    numbers = json.loads((tmp_path / "card" / "card.json").read_text())
    assert (
        set(numbers["judged"]) == {few[0].name, few[1].name}
        and numbers["task"] == "cartpole_swingup"
    )
    assert (tmp_path / "card" / "card.md").exists() and (tmp_path / "card" / "card.png").exists()
