"""Terms of arms and the things they move read where points of the scene are relative to each other."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from ksim_rl.envs.term import ObservationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.commands.pose import OfTarget, point_pos_w
from ksim_rl.mdp.fields import GaussianReward


@dataclass(frozen=True, kw_only=True)
class OffsetToBody(ObservationTerm):
    """Origin of a body minus a site, world frame, m, [E, 3]; position stage."""

    site: str
    body: str

    def __call__(self, view: EnvView) -> Float[Tensor, "E 3"]:
        return _offset(view, self.site, self.body)


@dataclass(frozen=True, kw_only=True)
class OffsetToCommand(OfTarget, ObservationTerm):
    """A commanded position minus where a body or site is, world frame, m, [E, 3]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E 3"]:
        return self.offset(view)


@dataclass(frozen=True, kw_only=True)
class NearBody(GaussianReward):
    """exp(-d^2 / std^2), `d` the distance of a site from a body's origin, m; position stage."""

    site: str
    body: str

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return self.rate(_offset(view, self.site, self.body).square().sum(-1))


def _offset(view: EnvView, site: str, body: str) -> Float[Tensor, "E 3"]:
    """Return the origin of a body minus a site, world frame, m."""
    return point_pos_w(view, body=body, site=None) - point_pos_w(view, body=None, site=site)
