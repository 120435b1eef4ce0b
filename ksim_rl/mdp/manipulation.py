"""Terms of arms and the things they move: where points of the scene are relative to each other."""

from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from ksim_rl.checks import check_choice
from ksim_rl.envs.term import ObservationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.commands.target_pose import (
    FRAMES,
    check_one_point,
    point_pos_w,
    target_pose_w,
)
from ksim_rl.mdp.rewards.gaussian_reward import GaussianReward


@dataclass(frozen=True, kw_only=True)
class OffsetToBody(ObservationTerm):
    """Origin of a body minus a site, world frame, m, [E, 3]; position stage."""

    site: str
    body: str

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return _offset(view, self.site, self.body)


@dataclass(frozen=True, kw_only=True)
class OffsetToCommand(ObservationTerm):
    """A commanded position minus where a body or site is, world frame, m, [E, 3]; position stage.

    Attributes:
        command: a position, such as `CartesianCommand`.
        body, site: what should be there; name one of the two.
        frame: that of the command.
        entity: whose root that frame is; "" is the first robot.
    """

    command: str
    body: str | None = None
    site: str | None = None
    frame: Literal["root", "world"] = "root"
    entity: str = ""

    def __post_init__(self) -> None:
        check_one_point(self.body, self.site)
        check_choice("frame", self.frame, FRAMES)

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        target_E3, _ = target_pose_w(view, view.command(self.command), frame=self.frame, entity=self.entity)
        return target_E3 - point_pos_w(view, body=self.body, site=self.site)


@dataclass(frozen=True, kw_only=True)
class NearBody(GaussianReward):
    """exp(-d^2 / std^2), `d` the distance of a site from a body's origin, m, [E]; position stage."""

    site: str
    body: str

    def __call__(self, view: EnvView) -> Tensor:
        """Return the unweighted reward, [E]."""
        return self.rate(_offset(view, self.site, self.body).square().sum(-1))


def _offset(view: EnvView, site: str, body: str) -> Tensor:
    """Return the origin of a body minus a site, world frame, m, [E, 3]."""
    return point_pos_w(view, body=body, site=None) - point_pos_w(view, body=None, site=site)
