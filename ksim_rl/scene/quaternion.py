"""Quaternion algebra on batches: unit quaternions (w, x, y, z), MuJoCo's order, in the last dim.

On a GPU each tensor operation is a kernel, and small ones cost the same however little they do: hence the vector forms.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def multiply(a: Float[Tensor, "*a 4"], b: Float[Tensor, "*b 4"]) -> Float[Tensor, "*batch 4"]:
    """Return the Hamilton product of quaternions [..., 4]."""
    aw = a[..., :1]
    au = a[..., 1:]
    bw = b[..., :1]
    bu = b[..., 1:]
    # Vector part: a_w b_u + b_w a_u + a_u x b_u.
    vector = torch.linalg.cross(au, bu)
    vector = torch.addcmul(vector, aw, bu)
    vector = torch.addcmul(vector, bw, au)
    scalar = aw * bw - (au * bu).sum(-1, keepdim=True)
    return torch.cat((scalar, vector), dim=-1)


def conjugate(q: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Return the inverse of unit quaternions [..., 4]."""
    return torch.cat((q[..., :1], -q[..., 1:]), dim=-1)


def rotate(q: Float[Tensor, "*q 4"], v: Float[Tensor, "*v 3"]) -> Float[Tensor, "*batch 3"]:
    """Rotate vectors [..., 3] by quaternions [..., 4] (body to world, if `q` is the body's orientation)."""
    w = q[..., :1]
    u = q[..., 1:]
    across = torch.linalg.cross(u, v)
    # Rodrigues: v + 2 (w (u x v) + u x (u x v)), which needs no conjugate.
    half_change = torch.addcmul(torch.linalg.cross(u, across), w, across)
    return torch.add(v, half_change, alpha=2.0)


def rotate_inverse(q: Float[Tensor, "*q 4"], v: Float[Tensor, "*v 3"]) -> Float[Tensor, "*batch 3"]:
    """Rotate vectors [..., 3] by the inverse of quaternions [..., 4] (world to body)."""
    w = q[..., :1]
    u = q[..., 1:]
    across = torch.linalg.cross(u, v)
    # The same with -w: the inverse turns the other way.
    half_change = torch.addcmul(torch.linalg.cross(u, across), w, across, value=-1.0)
    return torch.add(v, half_change, alpha=2.0)


def angle_between(a: Float[Tensor, "*a 4"], b: Float[Tensor, "*b 4"]) -> Float[Tensor, "*batch"]:
    """Return the angle of the rotation that turns orientation `a` into `b`, [..., 4] each: rad in [0, pi], [...]."""
    # By the chord, which unlike the cosine is well-conditioned at 0. `b` and `-b` are the same orientation.
    to_b = torch.linalg.vector_norm(a - b, dim=-1)
    to_minus_b = torch.linalg.vector_norm(a + b, dim=-1)
    chord = torch.minimum(to_b, to_minus_b)
    # A chord of 2 sin(angle / 4); rounding may lead beyond 1.
    return 4.0 * torch.asin((0.5 * chord).clamp(max=1.0))


def yaw(q: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch"]:
    """Return the heading of quaternions [..., 4]: the angle of the rotated x axis in the xy plane, rad, [...]."""
    w, x, y, z = q.unbind(-1)
    # Half of both arguments of the usual formula, which saves two products.
    half_sin = torch.addcmul(w * z, x, y)
    half_cos = 0.5 - torch.addcmul(y * y, z, z)
    return torch.atan2(half_sin, half_cos)


def from_euler_xyz(
    roll: Float[Tensor, "*batch"],
    pitch: Float[Tensor, "*batch"],
    yaw_angle: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch 4"]:
    """Return Rz(yaw) Ry(pitch) Rx(roll) as quaternions [..., 4]; angles in rad, [...]."""
    half = 0.5 * torch.stack((roll, pitch, yaw_angle), dim=-1)
    cos_sin = torch.stack((torch.cos(half), torch.sin(half)), dim=-1)
    # Ry(pitch) and Rz(yaw) as products cc, cs, sc, ss; then Rx(roll) from the right.
    of_pitch = cos_sin[..., 1, :, None]
    of_yaw = cos_sin[..., 2, None, :]
    products = (of_pitch * of_yaw).flatten(-2)
    cc, cs, sc, ss = products.unbind(-1)
    _, _, minus_sc, minus_ss = (-products).unbind(-1)
    by_cos = torch.stack((cc, minus_ss, sc, cs), dim=-1)
    by_sin = torch.stack((ss, cc, cs, minus_sc), dim=-1)
    cos_roll = cos_sin[..., 0, :1]
    sin_roll = cos_sin[..., 0, 1:]
    return torch.addcmul(cos_roll * by_cos, sin_roll, by_sin)


def wrap_to_pi(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Return the angle's equivalent in [-pi, pi), rad."""
    return torch.remainder(angle + torch.pi, 2.0 * torch.pi) - torch.pi


def turn_planar(
    v: Float[Tensor, "*batch 2"], angle: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 2"]:
    """Turn vectors of the xy plane about z by an angle, rad, counterclockwise seen from above."""
    cos = torch.cos(angle)
    sin = torch.sin(angle)
    x, y = v.unbind(-1)
    return torch.stack((cos * x - sin * y, sin * x + cos * y), dim=-1)
