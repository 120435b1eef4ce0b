"""Variables that are no numbers are refused by name."""

import pytest

from ksim_rl.cli.main import main
from ksim_rl.ranks.variables import number, world_size


@pytest.mark.parametrize("text", ["many", "-1", "1.5", "", "0x1"])
def test_what_is_no_number_is_refused_by_name(text, monkeypatch):
    monkeypatch.setenv("LOCAL_RANK", text)
    with pytest.raises(ValueError, match=f"LOCAL_RANK={text}: expected a whole number"):
        number("LOCAL_RANK")


@pytest.mark.parametrize(("text", "size"), [(None, 1), ("", 1), ("1", 1), ("4", 4)])
def test_one_process_needs_no_variable(text, size, monkeypatch):
    if text is None:
        monkeypatch.delenv("WORLD_SIZE", raising=False)
    else:
        monkeypatch.setenv("WORLD_SIZE", text)
    assert world_size() == size


@pytest.mark.parametrize(("size", "rank"), [("many", None), ("0", None), ("2", "5"), ("2", "one")])
def test_a_command_says_so_in_one_line(size, rank, monkeypatch, capsys):
    monkeypatch.setenv("WORLD_SIZE", size)
    monkeypatch.delenv("RANK", raising=False)
    others = {"LOCAL_RANK": "0", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "1"}
    for name, text in (others | ({} if rank is None else {"RANK": rank})).items():
        monkeypatch.setenv(name, text)
    with pytest.raises(SystemExit) as ended:
        main(["train", "task=cartpole_balance", "device=cpu"])
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert said.count("\n") == 1 and (f"WORLD_SIZE={size}" in said or f"RANK={rank}" in said)
