import pytest

from benchmarks import command_line


def test_own_options_are_taken_out_and_the_rest_are_overrides():
    own, others = command_line.split(
        ["seeds=1,2", "task=a", "x.y=b=c"], {"seeds": "1", "steps": "32"}
    )
    assert own == {"seeds": "1,2", "steps": "32"}
    assert others == ["task=a", "x.y=b=c"]


def test_what_is_no_option_is_refused_with_the_near_ones():
    with pytest.raises(ValueError, match="'num_env': did you mean 'num_envs'"):
        command_line.options(["num_env=4"], {"num_envs": "4096"})
    with pytest.raises(ValueError, match="write num_envs=VALUE"):
        command_line.options(["num_envs"], {"num_envs": "4096"})
    for text in ("", "x", "0", "-1", "1.5", "1,,2"):
        with pytest.raises(ValueError, match="steps="):
            command_line.whole_numbers("steps", text)
    assert command_line.whole_numbers("seeds", "0,7", least=0) == [0, 7]


def test_a_misspelt_override_is_refused_with_the_near_ones():
    with pytest.raises(ValueError, match="did you mean 'num_envs'"):
        command_line.compose(["num_env=4"])


def test_a_wrong_value_is_one_line_and_an_exit_code(monkeypatch):
    def main():
        raise ValueError("steps=x:\n  expected a number")

    monkeypatch.delenv("KSIM_RL_TRACEBACK", raising=False)
    with pytest.raises(SystemExit, match=r"^error: steps=x: expected a number$"):
        command_line.run(main)
    with pytest.raises(SystemExit) as ended:
        command_line.run(lambda: 1)
    assert ended.value.code == 1
    monkeypatch.setenv("KSIM_RL_TRACEBACK", "1")
    with pytest.raises(ValueError, match="steps=x"):
        command_line.run(main)
