"""Names the iterations of a run that may have used frozen Python, and the last checkpoint before them."""

from pathlib import Path

from ksim_rl.envs.recorded_python import FrozenPythonError
from ksim_rl.trainers import checkpoint


def with_iterations(
    error: FrozenPythonError, *, iteration: int, folder: Path | None
) -> FrozenPythonError:
    """Return the error with the iterations that it is about, up to `iteration`, and with the last checkpoint before.

    `folder` has the checkpoints; None where there are none. An error about what comes next is returned as it is.
    """
    if not error.rollouts:
        return error
    # One rollout per iteration, so the suspects are the last iterations.
    first = iteration - error.rollouts + 1
    text = f"{error}. These are the iterations {first} to {iteration}"
    if folder is not None:
        path = checkpoint.newest_until(folder, first - 1)
        text += (
            "; no checkpoint is from before them"
            if path is None
            else f"; {path} is from before them"
        )
    return FrozenPythonError(text, rollouts=error.rollouts)
