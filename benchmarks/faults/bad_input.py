"""These rows give commands what they cannot take: wrong inputs of users, huge numbers, manifests of another state."""

from __future__ import annotations

from pathlib import Path

from benchmarks.faults.row import AT_LEAST, EXACTLY, Figures, Row


def crafted_manifests(folder: Path, *, manifests: int) -> Figures:
    """Craft manifests of a run, and resume each."""
    from tests.trainers.crafted_manifests import figures

    return figures(folder, manifests=manifests)


def wrong_inputs(folder: Path, *, inputs: int) -> Figures:
    """Give wrong words, terms, transforms and models, each to a process of its own."""
    from tests.cli.wrong_inputs import figures

    return figures(folder, inputs=inputs)


def huge_numbers(folder: Path, *, commands: int) -> Figures:
    """Give every whole number of a config values that no run can have, and some of them to whole commands."""
    from tests.cli.wrong_sizes import figures

    return figures(folder, commands=commands)


ROWS = {
    "wrong_inputs": Row(
        fault="words of the command line, terms, transforms and models that cannot be, each tried alone",
        must="one line names what is wrong, exit code 2 or 3, without a traceback unless a user's own code raised; or "
        "it works",
        limits={"inputs": (AT_LEAST, "inputs"), "neither": (EXACTLY, 0)},
        measure=wrong_inputs,
        amounts={"inputs": 200},
        short={"inputs": 8},
        files=(
            "ksim_rl/checked.py",
            "ksim_rl/cli/errors.py",
            "ksim_rl/envs/registry.py",
            "tests/cli/wrong_inputs.py",
            "tests/cli/wrong_models.py",
            "tests/cli/wrong_terms.py",
        ),
    ),
    "huge_numbers": Row(
        fault="10^12, 2 * 10^9 and -1 for every whole number of a config, as on a machine of 1 GiB; some by a command",
        must="refused by the field's name before anything is built, but for those on which no memory depends; a "
        "command says so within 60 s",
        limits={
            "fields": (AT_LEAST, 50),
            "commands": (AT_LEAST, "commands"),
            **dict.fromkeys(("not_refused", "not_named", "neither"), (EXACTLY, 0)),
        },
        measure=huge_numbers,
        amounts={"commands": 10},
        short={"commands": 1},
        files=("ksim_rl/checked.py", "ksim_rl/device/room.py", "tests/cli/wrong_sizes.py"),
    ),
    "crafted_manifests": Row(
        fault="manifests with a right hash in which parts of the state are gone, or of another kind",
        must="refused in one line, exit code 2, or resumed where the part is not needed",
        limits={"manifests": (AT_LEAST, "manifests"), "not_refused_in_one_line": (EXACTLY, 0)},
        measure=crafted_manifests,
        amounts={"manifests": 20},
        short={"manifests": 4},
        files=("ksim_rl/trainers", "tests/trainers/crafted_manifests.py"),
    ),
}
