"""Terms compare a commanded pose with where a body or site is; what they share stands here."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.fields import InFrame
from ksim_rl.scene import quaternion


@dataclass(frozen=True, kw_only=True)
class OfTarget(InFrame):
    """A term of a body or site and of the position that a command asks it to take.

    Attributes:
        command: a position, with an orientation or not, such as `CartesianCommand` or `StartPoseCommand`, in `frame`.
        body, site: what should be there; name one of the two.
    """

    command: str
    body: str | None = None
    site: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.body is None) == (self.site is None):
            raise ValueError(f"body={self.body!r}, site={self.site!r}: name exactly one of the two")

    def offset(self, view: EnvView) -> Float[Tensor, "E 3"]:
        """Return the commanded position minus where the body or site is, world frame, m; position stage."""
        target_E3, _ = target_pose_w(view, view.command(self.command), frame=self.frame, entity=self.entity)
        return target_E3 - point_pos_w(view, body=self.body, site=self.site)

    def distance(self, view: EnvView) -> Float[Tensor, " E"]:
        """Return how far the body or site is from the commanded position, m; position stage."""
        return torch.linalg.vector_norm(self.offset(view), dim=-1)


def target_pose_w(
    view: EnvView, target_EK: Float[Tensor, "E K"], *, frame: Literal["root", "world"], entity: str = ""
) -> tuple[Float[Tensor, "E 3"], Float[Tensor, "E 4"] | None]:
    """Return a target's position in the world frame, m, and its quaternion there if the target has one.

    Args:
        target_EK: position [E, 3], or position and quaternion (w, x, y, z) [E, 7], in `frame`.
        frame, entity: see `InFrame`.
    """
    pos_E3, quat_E4 = target_EK[:, :3], target_EK[:, 3:] if target_EK.shape[1] == 7 else None
    if frame == "world":
        return pos_E3, quat_E4
    root = view.entity(entity)
    pos_E3 = root.root_pos_EL + quaternion.rotate(root.root_quat_EL, pos_E3)
    return pos_E3, None if quat_E4 is None else quaternion.multiply(root.root_quat_EL, quat_E4)


def point_pos_w(view: EnvView, *, body: str | None, site: str | None) -> Float[Tensor, "E 3"]:
    """Return the position of the one body or site that is named, world frame, m; position stage.

    Raises:
        ValueError: if several match the name.
    """
    if site is not None:
        return view.site(site).pos_EL
    assert body is not None
    return view.body(body).pos_EL
