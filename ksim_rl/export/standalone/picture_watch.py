"""Finds cameras that are frozen: their pictures are old, or equal to the bit for too long."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ksim_rl.export.standalone.files import Array, Json, check_count
from ksim_rl.export.standalone.robot_link import Measurement
from ksim_rl.export.standalone.safety import Fault, Limits


@dataclass(kw_only=True)
class Seen:
    """What a camera gave last: when a picture of it was new, s, and which one that was."""

    at: float
    picture: Array


class PictureWatch:
    """Refuses pictures that no camera takes any more, by Fault with one line that names the camera.

    A picture with a stamp may be as old as `late_periods` of its camera's periods, and as its lag in training is at
    most. One without a stamp may be equal to those before it for `same_seconds`, and for no less than that age: a
    camera has noise, as a gyroscope has.
    """

    def __init__(self, pictures: Sequence[Json], limits: Limits, period: float) -> None:
        self.oldest: dict[str, float] = {}
        for spec in pictures:
            steps = limits.late_periods * max(
                check_count("env steps of a camera", spec["every"]), 1
            )
            if spec["delay"]:
                steps += check_count("steps of a delay", spec["delay"]["max"])
            self.oldest[spec["input"]] = steps * period
        self.same_seconds = limits.same_seconds
        self.seen: dict[str, Seen] = {}

    def __call__(self, now: float, measurement: Measurement) -> None:
        """Look at the pictures of a measurement at a time, s of `time.monotonic`."""
        for name, oldest in self.oldest.items():
            # A robot without this camera promised nothing; the reader of the picture reports it.
            if name in measurement.picture_stamps:
                self._check_age(name, now - measurement.picture_stamps[name], oldest)
            elif name in measurement.pictures:
                self._check_news(name, now, measurement.pictures[name])

    def _check_age(self, name: str, age: float, oldest: float) -> None:
        if age > oldest:
            raise Fault(
                f"{name}: its newest picture is {age:.3f} s old: expected one in {oldest:.3f} s: is the camera frozen?"
            )
        # By such a clock no picture would ever be old. A stamp that is NaN comes here, too.
        if not age >= -oldest:
            raise Fault(
                f"{name}: the stamp of its picture is {-age:.3f} s ahead of the loop: expected s of time.monotonic"
            )

    def _check_news(self, name: str, now: float, picture: Array) -> None:
        last = self.seen.get(name)
        if last is None or not np.array_equal(last.picture, picture):
            # A copy: a camera may write into its array.
            self.seen[name] = Seen(at=now, picture=np.array(picture))
            return
        same = now - last.at
        if same > max(self.same_seconds, self.oldest[name]):
            raise Fault(
                f"{name}: its pictures are the same for {same:.3f} s: is the camera frozen? One without noise has to "
                "give picture_stamps"
            )
