"""Observations of things in the world, as they look from a root or from the world itself."""

from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from ksim_rl.checks import check_choice
from ksim_rl.envs.term import ObservationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.commands.target_pose import FRAMES
from ksim_rl.scene import quaternion


@dataclass(frozen=True, kw_only=True)
class FramedObservation(ObservationTerm):
    """What terms with a choice of frame share.

    Attributes:
        frame: "root": positions are relative to the root's frame, velocities and forces are given in its axes (they
            remain velocities over the ground, as `RootLinVel` is); "world".
        entity: whose root; "" is the first robot.
    """

    frame: Literal["root", "world"] = "root"
    entity: str = ""

    def __post_init__(self) -> None:
        check_choice("frame", self.frame, FRAMES)

    def points(self, view: EnvView, pos_EN3: Tensor) -> Tensor:
        """Return points of the world in the term's frame, m, flat, [E, 3N]."""
        if self.frame == "root":
            pos_EN3 = pos_EN3 - view.entity(self.entity).root_pos_EL[:, None]
        return self.vectors(view, pos_EN3)

    def vectors(self, view: EnvView, vector_EN3: Tensor) -> Tensor:
        """Return vectors of the world in the term's axes, flat, [E, 3N]."""
        if self.frame == "root":
            vector_EN3 = quaternion.rotate_inverse(view.entity(self.entity).root_quat_EL[:, None], vector_EN3)
        return vector_EN3.flatten(start_dim=1)
