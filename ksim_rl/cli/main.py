"""`ksim-rl <command>` starts here: the command is found, and errors of users become one line."""

import gc
import importlib
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from ksim_rl.cli.errors import REFUSED, interruption, report, say, sigterm_interrupts
from ksim_rl.cli.process import check_process
from ksim_rl.files.writing import open_streams
from ksim_rl.terminal import show, show_warnings_as_lines

USAGE = """\
usage: ksim-rl <command> [arguments]

  train    train a policy:          ksim-rl train task=cartpole_swingup num_envs=512
           a run once more:         ksim-rl train --config-dir RUN
           from its weights:        ksim-rl train checkpoint=RUN
  resume   continue a run:          ksim-rl resume RUN
  eval     evaluate a policy:       ksim-rl eval RUN --episodes 100
           in MuJoCo's C engine:    ksim-rl eval RUN task.sim.engine=c
           how often it follows its motion: ksim-rl eval RUN --trials 1024
  play     record a video:          ksim-rl play RUN --seconds 10
           watch and drive it:      ksim-rl play RUN --live
           without a policy:        ksim-rl play task=cartpole_swingup --agent random --live
  collect  episodes of a policy, in a folder:  ksim-rl collect RUN --episodes 1000
           without a policy:        ksim-rl collect task=cartpole_swingup --agent random
  demo     a policy of the zoo, without training: ksim-rl demo [--live]
  zoo      list those that come along:   ksim-rl zoo; ksim-rl play zoo:reacher
  runs     list runs, with return and speed:  ksim-rl runs [FOLDER]
  compare  a table and a picture:   ksim-rl compare RUN1 RUN2
  export   a folder that runs elsewhere:  ksim-rl export RUN, or zoo:go1
  sim2sim  run it on MuJoCo's C engine:   ksim-rl sim2sim RUN/export --episodes 100
  card     what a policy keeps under other conditions:  ksim-rl card zoo:go1 --episodes 32
  identify the numbers of a robot's joints, from a log:  ksim-rl identify LOG.csv --robot go2
           what to log:             ksim-rl identify --propose go2
  diagnose what goes wrong in learning:   ksim-rl diagnose RUN
  doctor   check this machine, for bug reports: ksim-rl doctor
  warmup   compile ahead of time:   ksim-rl warmup task=go1_velocity_flat device=cuda
  envs     list the tasks, or print what one is made of: ksim-rl envs cartpole_swingup
  robot    analyse a robot's model: ksim-rl robot unitree_a1/a1 [--code]
  new      a package around it:     ksim-rl new robot PATH.xml
           a file with a task:      ksim-rl new task NAME
  motion   a recording as a motion: ksim-rl motion bvh dance.bvh dance.npz --pairs pairs.yaml
  completion  complete words in a shell:  eval "$(ksim-rl completion bash)"
  reproduce  run a table of results: ksim-rl reproduce dm_control --rows 'ppo/Cart.*'

RUN is a run folder (its newest checkpoint) or one of its checkpoints.
--plugin PACKAGE, with any command and repeatable, imports a package of yours: its tasks, and the terms, robots,
transforms, networks and algorithms that configs name. KSIM_RL_PLUGINS=PACKAGE,... does so for all commands; what is not
installed lies in a folder of KSIM_RL_PLUGIN_PATH, or for --plugin in the working directory.
`ksim-rl <command> --help` tells more. KSIM_RL_TRACEBACK=1 shows the traceback of an error.

exit codes: 0 done (and solved, or its target met, where there is one), 1 not solved, or a fault found, 2 refused: the
command or its configuration is wrong, 3 the run failed, 130 / 143 interrupted by SIGINT / SIGTERM: what is saved is
said"""

# Where each is: a module and its function, which takes the arguments and returns the exit code.
COMMANDS = {
    "train": "ksim_rl.cli.train:train",
    "resume": "ksim_rl.cli.run_commands:resume",
    "eval": "ksim_rl.cli.run_commands:evaluate",
    "play": "ksim_rl.viewer.play_command:play",
    "collect": "ksim_rl.cli.collect:collect",
    "demo": "ksim_rl.viewer.play_command:demo",
    "zoo": "ksim_rl.zoo.command:zoo",
    "runs": "ksim_rl.cli.runs:runs",
    "compare": "ksim_rl.cli.runs:compare",
    "export": "ksim_rl.cli.export:run_export",
    "sim2sim": "ksim_rl.export.sim2sim:run_sim2sim",
    "card": "ksim_rl.transfer.command:card",
    "identify": "ksim_rl.identification.command:identify",
    "diagnose": "ksim_rl.diagnosis.diagnose:command",
    "doctor": "ksim_rl.diagnosis.doctor:command",
    "warmup": "ksim_rl.cli.warmup:warmup",
    "envs": "ksim_rl.cli.run_commands:list_envs",
    "robot": "ksim_rl.cli.run_commands:robot",
    "new": "ksim_rl.cli.new:new",
    "motion": "ksim_rl.tracking.motion_command:motion",
    "completion": "ksim_rl.cli.completion:completion",
    "reproduce": "ksim_rl.tables.reproduce:reproduce",
}


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if argv is None:  # called as a program
        # Libraries start Python too: compilers of kernels, launchers of jobs. As with `-P`, the working directory,
        # which may be a stranger's, is not on the path of these.
        os.environ["PYTHONSAFEPATH"] = "1"
        open_streams()
        show_warnings_as_lines()
    try:
        # SIGTERM ends a run as Ctrl-C does: it saves and says so.
        with sigterm_interrupts():
            code = _dispatch(arguments)
    except KeyboardInterrupt as stopped:
        number = interruption(stopped)
        # A command that writes catches the interruption itself.
        say(f"{number.name}: interrupted; nothing was being written")
        code = 128 + int(number)
    except Exception as error:
        code = report(error)
    sys.exit(code)


def _dispatch(words: list[str]) -> int:
    # `--plugin` may stand before the command, too.
    arguments, names = _without_plugins(words)
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        show(USAGE)
        if arguments:
            return 0
        return REFUSED
    command, *rest = arguments
    if command == "--version":
        from ksim_rl import __version__

        show(f"ksim-rl {__version__}")
        return 0
    if command not in COMMANDS:
        from ksim_rl.checks import unknown_name

        raise unknown_name("command", command, COMMANDS)
    check_process()
    # Imported here, so that usage and mistyped commands answer at once.
    module, _, function = COMMANDS[command].partition(":")
    with gc_disabled():
        run = getattr(importlib.import_module(module), function)
        # Plug-ins before the command: it may name their tasks.
        importlib.import_module("ksim_rl.config.plugins").load_from_here(names, note=say)
    # torchrun sets the number of ranks.
    if os.environ.get("WORLD_SIZE", "") in ("", "1"):
        return run(rest)
    with importlib.import_module("ksim_rl.ranks").joined(command):
        code = run(rest)
    # Not solved is no failure of a rank, which torchrun would start again.
    return 0 if code == 1 else code


def _without_plugins(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Take `--plugin NAME` and `--plugin=NAME` out of a command's arguments; return those left, and the names."""
    left = []
    names = []
    following = iter(arguments)
    for argument in following:
        # Both spellings: the name in the same word, or in the next one.
        flag, equals, name = argument.partition("=")
        if flag != "--plugin":
            left.append(argument)
            continue
        if not equals:
            name = next(following, "")
        if not name or name.startswith("-"):
            raise ValueError("--plugin: expected the name of a package after it")
        names.append(name)
    return left, names


@contextmanager
def gc_disabled() -> Iterator[None]:
    """Import without the garbage collector, which would look through all modules again and again, and at exit too."""
    if "torch" in sys.modules:  # called by a program whose objects are not ours to freeze
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        # Objects of the imports live to the end: the collector need not look at them again.
        gc.freeze()
        gc.enable()


if __name__ == "__main__":
    main()
