"""Runs each term of a new env once, so that a term that writes memory of others is refused before the first step."""

from collections.abc import Sequence
from typing import Protocol

from ksim_rl.envs.driver import EnvDriver
from ksim_rl.scene.actuators import JointDrives


class Rehearsed(Protocol):
    """A manager whose terms can run once more."""

    def rehearse(self) -> None:
        """Run each term for no row, or for all where a term only reads; the caller puts back what changes."""


def rehearse(
    driver: EnvDriver,
    *,
    laws: JointDrives,
    writing: Sequence[Rehearsed],
    reading: Sequence[Rehearsed],
) -> None:
    """Run all terms, and put back all changes; a ValueError names a term that wrote memory of others.

    `writing` are the managers of terms that write the worlds, `reading` the managers of terms that only read them.
    """
    # Watches all writes, and puts the state back at the end.
    with driver.guard.rehearsal():
        for manager in writing:
            manager.rehearse()
            # The next ones may read what derives from the state.
            driver.world.refresh()
            driver.refreshed()
        # Motor models and sensors, in the order of an env step.
        laws.apply()
        driver.update_sensors()
        # Twice: a change to a quantity by its first reader shows the second time.
        for _ in range(2):
            for manager in reading:
                manager.rehearse()
    # Numbers of the rehearsal are of no state that anybody sees.
    driver.non_finite.start()
