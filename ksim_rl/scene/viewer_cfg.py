"""The camera of `render()`."""

import re
from dataclasses import dataclass

from ksim_rl.checks import check_in_range


@dataclass(frozen=True, kw_only=True)
class ViewerCfg:
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
    distance: float = 3.0
    elevation: float = -20.0
    azimuth: float = 120.0
    width: int = 640
    height: int = 480
    env_index: int = 0
    num_envs: int = 1
    draw: tuple[str, ...] = (".*",)

    def __post_init__(self) -> None:
        check_in_range("distance", self.distance, low=0.0, low_open=True)
        check_in_range("elevation", self.elevation, low=-90.0, high=90.0)
        check_in_range("azimuth", self.azimuth, low=-360.0, high=360.0)
        for field in ("width", "height", "num_envs"):
            check_in_range(field, getattr(self, field), low=1)
        check_in_range("env_index", self.env_index, low=0)
        for index, pattern in enumerate(self.draw):
            try:
                re.compile(pattern)
            except re.error as error:
                raise ValueError(f"draw[{index}]={pattern!r}: no regular expression: {error}") from None
