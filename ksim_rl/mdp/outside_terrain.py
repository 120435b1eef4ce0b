"""The end of a patch of ground."""

from dataclasses import dataclass

from torch import Tensor

from ksim_rl.checks import check_in_range
from ksim_rl.envs.term import TerminationTerm
from ksim_rl.envs.view import EnvView


@dataclass(frozen=True, kw_only=True)
class OutsideTerrain(TerminationTerm):
    """The root is beyond the edge of its env's ground, or nearer to it than a margin: a truncation, not a failure.

    On ground without end it never is.

    Attributes:
        margin: m inside of the edge; robots whose feet must not step over it need about their own reach.
        entity: the robot or object; "" is the first robot.
    """

    time_out: bool = True
    margin: float = 0.5
    entity: str = ""

    def __post_init__(self) -> None:
        check_in_range("margin", self.margin, low=0.0)

    def __call__(self, view: EnvView) -> Tensor:
        """Return which envs end, bool [E]."""
        reach_E = view.entity(self.entity).root_pos_EL[:, :2].abs().amax(-1)
        return reach_E > view.terrain.half_width - self.margin
