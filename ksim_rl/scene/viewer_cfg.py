"""Configures the camera of `render()`."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from ksim_rl.checked import Checked, Count, Positive, WholeNumber, Within
from ksim_rl.checks import naming


@dataclass(frozen=True, kw_only=True)
class ViewerCfg(Checked):
    """The camera of `render()`.

    Attributes:
        draw: regular expressions that match in full "commands/<name>", "rewards/<name>" and "sensors/<name>" of those
            that can draw themselves.
    """

    body: str | None = None  # the body that it follows
    lookat: tuple[float, float, float] = (0.0, 0.0, 0.5)  # m, where no body is followed
    distance: Positive = 3.0  # m from the body or point that it looks at
    elevation: Annotated[
        float, Within(low=-90.0, high=90.0)
    ] = -20.0  # degrees, as in MuJoCo's free camera
    azimuth: Annotated[float, Within(low=-360.0, high=360.0)] = 120.0  # degrees
    width: Count = 640  # pixels
    height: Count = 480  # pixels
    env_index: WholeNumber = 0  # the env that is drawn
    num_envs: Count = 1  # drawn in one picture, `scene.spacing` apart, from `env_index` on
    draw: tuple[str, ...] = (".*",)

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return the pixels of a picture."""
        return {("width", "height"): self.width * self.height}

    def _check_fields(self) -> None:
        super()._check_fields()
        # Refused here, where the field can be named, and not at the first picture.
        for index, pattern in enumerate(self.draw):
            with naming(f"draw[{index}]={pattern!r}: no regular expression", re.error):
                re.compile(pattern)
