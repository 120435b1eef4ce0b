"""Quaternion algebra on batches: unit quaternions (w, x, y, z), MuJoCo's order, in the last dim."""

import torch
from torch import Tensor


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """Return the Hamilton product of quaternions [..., 4]."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        dim=-1,
    )


def conjugate(q: Tensor) -> Tensor:
    """Return the inverse of unit quaternions [..., 4]."""
    return torch.cat((q[..., :1], -q[..., 1:]), dim=-1)


def rotate(q: Tensor, v: Tensor) -> Tensor:
    """Rotate vectors [..., 3] by quaternions [..., 4] (body to world, if `q` is the body's orientation)."""
    w, u = q[..., :1], q[..., 1:]
    t = 2.0 * torch.linalg.cross(u, v)
    return v + w * t + torch.linalg.cross(u, t)


def rotate_inverse(q: Tensor, v: Tensor) -> Tensor:
    """Rotate vectors [..., 3] by the inverse of quaternions [..., 4] (world to body)."""
    w, u = q[..., :1], q[..., 1:]
    t = 2.0 * torch.linalg.cross(u, v)
    return v - w * t + torch.linalg.cross(u, t)


def angle_between(a: Tensor, b: Tensor) -> Tensor:
    """Return the angle of the rotation that turns orientation `a` into `b`, [..., 4] each: rad in [0, pi], [...]."""
    # By the chord, which unlike the cosine is well-conditioned at 0. `b` and `-b` are the same orientation.
    chord = torch.minimum(torch.linalg.vector_norm(a - b, dim=-1), torch.linalg.vector_norm(a + b, dim=-1))
    return 4.0 * torch.asin((0.5 * chord).clamp(max=1.0))


def yaw(q: Tensor) -> Tensor:
    """Return the heading of quaternions [..., 4]: the angle of the rotated x axis in the xy plane, rad, [...]."""
    w, x, y, z = q.unbind(-1)
    return torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def from_euler_xyz(roll: Tensor, pitch: Tensor, yaw_angle: Tensor) -> Tensor:
    """Return Rz(yaw) Ry(pitch) Rx(roll) as quaternions [..., 4]; angles in rad, [...]."""
    cr, sr = torch.cos(roll / 2), torch.sin(roll / 2)
    cp, sp = torch.cos(pitch / 2), torch.sin(pitch / 2)
    cy, sy = torch.cos(yaw_angle / 2), torch.sin(yaw_angle / 2)
    return torch.stack(
        (
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ),
        dim=-1,
    )


def wrap_to_pi(angle: Tensor) -> Tensor:
    """Return the angle's equivalent in [-pi, pi), rad."""
    return torch.remainder(angle + torch.pi, 2.0 * torch.pi) - torch.pi
