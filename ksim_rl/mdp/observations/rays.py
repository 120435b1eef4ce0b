"""These observations read what a `RayCaster` of `scene.sensors` hits."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from ksim_rl.checks import check_in_range, check_pair
from ksim_rl.envs.term import ObservationTerm
from ksim_rl.envs.view import EnvView


@dataclass(frozen=True, kw_only=True)
class RayDistance(ObservationTerm):
    """Distances to what the rays hit, m, the sensor's `max_distance` where they hit nothing, [E, N]; position stage."""

    sensor: str

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.rays(self.sensor).state.distance_EN


@dataclass(frozen=True, kw_only=True)
class RayHeight(ObservationTerm):
    """How far the ends of the rays are below the sensor, minus `offset`, clipped, m, [E, N]; position stage.

    With a `GridPattern` that starts well above the robot it is a height scan that sees everything, not only terrain.

    Attributes:
        offset: m.
        clip: readings are clipped to this range, m.
    """

    sensor: str
    offset: float = 0.0
    clip: tuple[float, float] = (-1.0, 1.0)

    def __post_init__(self) -> None:
        check_in_range("offset", self.offset)
        check_pair("clip", self.clip)

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        tracker = view.rays(self.sensor)
        below_EN = tracker.origin_E3[:, 2:] - tracker.state.point_EN3[..., 2] - self.offset
        return below_EN.clamp(*self.clip)
