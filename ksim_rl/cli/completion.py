"""`ksim-rl completion bash` prints a script that completes commands, groups, tasks and fields in a shell."""

from collections.abc import Iterable
from importlib.resources import files
from string import Template

from ksim_rl import conf
from ksim_rl.checks import OneLineParser
from ksim_rl.terminal import show

# Commands that take overrides of a run's config.
COMPOSING = ("train", "warmup", "play")
WITH_TASKS = ("envs",)
SHELLS = ("bash", "zsh")


def completion(arguments: list[str]) -> int:
    """Print the script, which holds all words: completing them starts no Python."""
    parser = OneLineParser(
        prog="ksim-rl completion",
        description='Print a script for your shell: eval "$(ksim-rl completion bash)". It has tasks of a plug-in where '
        "--plugin names that.",
    )
    parser.add_argument("shell", choices=SHELLS)
    options = parser.parse_args(arguments)
    from ksim_rl.cli.main import COMMANDS

    words = conf.completions()
    tasks = [word.removeprefix("task=") for word in words if word.startswith("task=")]
    template = files("ksim_rl.cli").joinpath("completion.sh.txt").read_text()
    script = Template(template).substitute(
        commands=_joined(COMMANDS),
        composing="|".join(COMPOSING),
        words=_joined(words),
        with_tasks="|".join(WITH_TASKS),
        tasks=_joined(tasks),
    )
    # zsh runs scripts for bash with this.
    before = "autoload -U +X compinit && compinit && autoload -U +X bashcompinit && bashcompinit\n"
    show(before + script if options.shell == "zsh" else script, end="")
    return 0


def _joined(words: Iterable[str]) -> str:
    return " ".join(words)
