"""This module configures the camera of `render()`."""

import re
from dataclasses import dataclass
from typing import Annotated

from ksim_rl.checked import Checked, Count, Positive, WholeNumber, Within


@dataclass(frozen=True, kw_only=True)
class ViewerCfg(Checked):
    """A camera that follows a body, or looks at a point.

    Attributes:
        body: the body that the camera tracks; None looks at `lookat`.
        lookat: m, world frame; used if `body` is None.
        distance: m from what it looks at.
        elevation, azimuth: degrees, as in MuJoCo's free camera.
        width, height: pixels.
        env_index: the env that is drawn.
        num_envs: how many envs are drawn in the picture, `scene.spacing` apart, from `env_index` on.
        draw: which of the commands, rewards and sensors that can draw themselves do so: regular expressions for
            "commands/<name>", "rewards/<name>" and "sensors/<name>" that match in full; () for none.
    """

    body: str | None = None
    lookat: tuple[float, float, float] = (0.0, 0.0, 0.5)
    distance: Positive = 3.0
    elevation: Annotated[float, Within(low=-90.0, high=90.0)] = -20.0
    azimuth: Annotated[float, Within(low=-360.0, high=360.0)] = 120.0
    width: Count = 640
    height: Count = 480
    env_index: WholeNumber = 0
    num_envs: Count = 1
    draw: tuple[str, ...] = (".*",)

    def __post_init__(self) -> None:
        super().__post_init__()
        for index, pattern in enumerate(self.draw):
            try:
                re.compile(pattern)
            except re.error as error:
                raise ValueError(f"draw[{index}]={pattern!r}: no regular expression: {error}") from None
