"""Observations of things in the world look at them from a root or from the world itself; this is their base."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from ksim_rl.envs.term import ObservationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.fields import InFrame
from ksim_rl.scene import quaternion


@dataclass(frozen=True, kw_only=True)
class FramedObservation(InFrame, ObservationTerm):
    """An observation in a frame: positions are relative to its origin, velocities and forces given in its axes.

    In the root's frame they remain velocities over the ground, as `RootLinVel` is.
    """

    def points(self, view: EnvView, pos_EN3: Float[Tensor, "E N 3"]) -> Float[Tensor, "E L"]:
        """Return points of the world in the term's frame, m, flat, [E, 3N]."""
        if self.frame == "root":
            pos_EN3 = pos_EN3 - view.entity(self.entity).root_pos_EL[:, None]
        return self.vectors(view, pos_EN3)

    def vectors(self, view: EnvView, vector_EN3: Float[Tensor, "E N 3"]) -> Float[Tensor, "E L"]:
        """Return vectors of the world in the term's axes, flat, [E, 3N]."""
        if self.frame == "root":
            vector_EN3 = quaternion.rotate_inverse(view.entity(self.entity).root_quat_EL[:, None], vector_EN3)
        return vector_EN3.flatten(start_dim=1)
