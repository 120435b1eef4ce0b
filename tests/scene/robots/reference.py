"""The reference figures and scenes, which live beside the repository, not in it."""

import json
import os
from pathlib import Path

import pytest

from tests.absent_models import skipped_without_models


def reference_file(name: str) -> Path:
    """Return a file of the reference folder, or skip the test with the reason.

    The folder is what the environment variable KSIM_RL_REFERENCE names, else `../shared/tasks` beside the repository.
    """
    repository = Path(__file__).parents[3]
    folder = Path(os.environ.get("KSIM_RL_REFERENCE", repository.parent / "shared" / "tasks"))
    if not (folder / name).is_file():
        pytest.skip(f"{name} is not in {folder}; KSIM_RL_REFERENCE names the folder")
    return folder / name


def reference_figures(robot: str) -> dict:
    """Return the figures of a robot's velocity task, or skip."""
    return json.loads(reference_file("velocity_flat.json").read_text())[robot]


def loaded_spec(robot):
    """Return the robot's spec, or skip if the menagerie is not at hand."""
    with skipped_without_models():
        return robot.spec()
