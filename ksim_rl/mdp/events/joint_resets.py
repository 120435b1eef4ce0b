"""These events reset joints to positions near the default pose."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import Range
from ksim_rl.checks import check_in_range, check_pair
from ksim_rl.envs.term import EventTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant
from ksim_rl.mdp.fields import OfJoints


@dataclass(frozen=True, kw_only=True)
class JointReset(OfJoints, EventTerm):
    """A reset of joints, whose positions stay in the soft limits."""

    def write(
        self,
        view: EnvView,
        mask_E: Bool[Tensor, " E"],
        pos_EL: Float[Tensor, "E L"],
        vel_EL: Float[Tensor, "E L"],
    ) -> None:
        """Set positions and velocities of the joints in the rows of `mask_E`."""
        joints = view.joints(self.joints)
        low_L, high_L = joints.soft_limits_L2.unbind(-1)
        joints.write_pos(mask_E, torch.clamp(pos_EL, low_L, high_L))
        joints.write_vel(mask_E, vel_EL)


@dataclass(frozen=True, kw_only=True)
class ResetJoints(JointReset):
    """Put joints at their default positions plus an offset, at a drawn velocity.

    Attributes:
        position_range: rad or m. With `distribution="gaussian"`: (mean, standard deviation).
        velocity_range: rad/s or m/s; likewise.
    """

    position_range: tuple[float, float] = (0.0, 0.0)
    velocity_range: tuple[float, float] = (0.0, 0.0)
    distribution: Literal["uniform", "gaussian"] = "uniform"

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("position_range", "velocity_range"):
            if self.distribution == "uniform":
                check_pair(name, getattr(self, name))
            else:
                check_in_range(f"{name}[1]", getattr(self, name)[1], low=0.0)

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        default_EL = view.joints(self.joints).default_pos_EL
        count = default_EL.shape[1]
        pos_EL = default_EL + self._draw(view, count, self.position_range)
        self.write(view, mask_E, pos_EL, self._draw(view, count, self.velocity_range))

    def _draw(self, view: EnvView, count: int, pair: tuple[float, float]) -> Float[Tensor, "E L"]:
        first, second = float(pair[0]), float(pair[1])
        if second == (0.0 if self.distribution == "gaussian" else first):
            return constant([first] * count, view.device).expand(view.num_envs, count)
        if self.distribution == "gaussian":
            return first + second * view.normal(count)
        return view.uniform(count, first, second)


@dataclass(frozen=True, kw_only=True)
class ResetJointsByScale(JointReset):
    """Put joints at their default positions times a uniform factor, per joint.

    Attributes:
        position_scale: the factor's range.
        velocity_range: rad/s or m/s, uniform.
    """

    position_scale: Range
    velocity_range: Range = (0.0, 0.0)

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        default_EL = view.joints(self.joints).default_pos_EL
        count = default_EL.shape[1]
        pos_EL = default_EL * view.uniform(count, *self.position_scale)
        self.write(view, mask_E, pos_EL, view.uniform(count, *self.velocity_range))
