"""The script of `ksim-rl completion` completes in a real bash; Hydra's own script is refused by name."""

import shutil
import subprocess

import pytest

from ksim_rl.cli import main

BASH = shutil.which("bash")


def run(*arguments):
    with pytest.raises(SystemExit) as stopped:
        main.main(list(arguments))
    return stopped.value.code


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    file = tmp_path_factory.mktemp("completion") / "ksim_rl.bash"
    with pytest.MonkeyPatch.context() as patch:
        printed = []
        patch.setattr("ksim_rl.cli.completion.show", lambda text, end="": printed.append(text))
        assert run("completion", "bash") == 0
    file.write_text("".join(printed))
    return file


def completed(script, line):
    """Return what bash would offer at the end of a line; it splits words at "=" too."""
    words = line.replace("=", " = ").split(" ")
    program = f"""
source {script}
COMP_LINE='{line}'; COMP_POINT={len(line)}; COMP_WORDS=({" ".join(f"'{word}'" for word in words)})
COMP_CWORD={len(words) - 1}
_ksim_rl
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
    done = subprocess.run([BASH, "-c", program], capture_output=True, text=True, check=True)
    assert not done.stderr
    return done.stdout.split()


@pytest.mark.skipif(BASH is None, reason="no bash")
@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("ksim-rl tr", ["train"]),
        ("ksim-rl train task=go2_velocity_", ["go2_velocity_flat"]),
        ("ksim-rl train task=g1_velocity_", ["g1_velocity_flat", "g1_velocity_rough"]),
        ("ksim-rl train objective.clip_e", ["objective.clip_epsilon="]),
        ("ksim-rl train seed=1 modules=g", ["gru"]),
        ("ksim-rl envs cartpole_s", ["cartpole_swingup", "cartpole_swingup_pixels"]),
        ("ksim-rl eval ru", []),
    ],
)
def test_bash_completes(script, line, offered):
    assert completed(script, line) == offered


def test_zsh_loads_what_runs_scripts_of_bash_first(capsys):
    assert run("completion", "zsh") == 0
    assert capsys.readouterr().out.startswith("autoload -U +X compinit")


def test_hydras_own_script_is_refused(capsys):
    assert run("train", "--shell-completion", "install=bash") == 2
    assert "ksim-rl completion bash prints a script" in capsys.readouterr().err
