"""Commanded poses in the world frame, and how far a body or site is from them."""

from typing import Literal

import torch
from torch import Tensor

from ksim_rl.envs.view import EnvView
from ksim_rl.scene import quaternion

FRAMES = ("root", "world")


def target_pose_w(
    view: EnvView, target_EK: Tensor, *, frame: Literal["root", "world"], entity: str = ""
) -> tuple[Tensor, Tensor | None]:
    """Return a target pose in the world frame: position, m, [E, 3], and quaternion [E, 4] if the target has one.

    Args:
        target_EK: position [E, 3], or position and quaternion (w, x, y, z) [E, 7], in `frame`.
        frame: "root": the frame of the root body of `entity`; "world".
        entity: "" is the first robot.
    """
    pos_E3, quat_E4 = target_EK[:, :3], target_EK[:, 3:] if target_EK.shape[1] == 7 else None
    if frame == "world":
        return pos_E3, quat_E4
    root = view.entity(entity)
    pos_E3 = root.root_pos_EL + quaternion.rotate(root.root_quat_EL, pos_E3)
    return pos_E3, None if quat_E4 is None else quaternion.multiply(root.root_quat_EL, quat_E4)


def point_pos_w(view: EnvView, *, body: str | None, site: str | None) -> Tensor:
    """Return the position of the one body or site that is named, world frame, m, [E, 3]; position stage.

    Raises:
        ValueError: if several match the name.
    """
    if site is not None:
        return view.site(site).pos_EL
    assert body is not None
    return view.body(body).pos_EL


def check_one_point(body: str | None, site: str | None) -> None:
    """Refuse anything but exactly one name.

    Raises:
        ValueError: naming both fields.
    """
    if (body is None) == (site is None):
        raise ValueError(f"body={body!r}, site={site!r}: name exactly one of the two")


def distance_to_target(
    view: EnvView,
    command: str,
    *,
    frame: Literal["root", "world"],
    body: str | None,
    site: str | None,
    entity: str = "",
) -> Tensor:
    """Return how far a body or site is from the position that a command asks for, m, [E]."""
    pos_E3, _ = target_pose_w(view, view.command(command), frame=frame, entity=entity)
    return torch.linalg.vector_norm(point_pos_w(view, body=body, site=site) - pos_E3, dim=-1)
