"""These rows give commands what they cannot take: manifests of another state, and wrong inputs of users."""

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


ROWS = {
    "wrong_inputs": Row(
        fault="words of the command line, any whole number of a config, terms, transforms and models that cannot be",
        must="one line names what is wrong, exit code 2 or 3, without a traceback unless a user's own code raised; or "
        "it works",
        limits={"inputs": (AT_LEAST, "inputs"), "neither": (EXACTLY, 0)},
        measure=wrong_inputs,
        amounts={"inputs": 400},
        short={"inputs": 8},
        files=(
            "ksim_rl/checked.py",
            "ksim_rl/cli/errors.py",
            "ksim_rl/device/memory.py",
            "ksim_rl/envs/registry.py",
            "tests/cli/wrong_inputs.py",
            "tests/cli/wrong_models.py",
            "tests/cli/wrong_sizes.py",
            "tests/cli/wrong_terms.py",
        ),
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
