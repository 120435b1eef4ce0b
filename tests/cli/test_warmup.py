import pytest

from ksim_rl.cli import main


def run(*words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main.main(list(words))
    return int(ended.value.code or 0)


def test_warmup_says_how_long_it_took_and_where_the_kernels_are(capsys):
    sizes = ("num_envs=4", "data.num_env_states_per_minibatch=8", "data.num_minibatches=2")
    assert run("warmup", "task=cartpole_balance", "device=cpu", *sizes) == 0
    # Kernels that no cache has yet are announced.
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("cartpole_balance on cpu: ") and "kernel modules were compiled" in last


def test_a_wrong_override_is_refused(capsys):
    assert run("warmup", "task=cartpole_balance", "num_env=4") == main.REFUSED
    assert "num_env" in capsys.readouterr().err
