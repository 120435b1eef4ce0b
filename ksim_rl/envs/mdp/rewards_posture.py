"""Rewards for how the body is held: orientation, pose, joint limits, rotation."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from ksim_rl.checks import check_in_range
from ksim_rl.envs import quaternion
from ksim_rl.envs.mdp.command_speed import commanded_speed
from ksim_rl.envs.mdp.constants import constant, values_by_name
from ksim_rl.envs.names import Patterns
from ksim_rl.envs.term import RewardTerm
from ksim_rl.envs.view import EnvView


@dataclass(frozen=True, kw_only=True)
class Upright(RewardTerm):
    """exp(-|g_xy|^2 / std^2), `g` the direction of gravity in the body's frame, [E]; position stage.

    Attributes:
        body: the body to hold upright; None is the root.
    """

    std: float
    body: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_in_range("std", self.std, low=0.0, low_open=True)

    def __call__(self, view: EnvView) -> Tensor:
        """Return the unweighted reward, [E]."""
        if self.body is None:
            gravity_E3 = view.projected_gravity_EL
        else:
            down_13 = constant((0.0, 0.0, -1.0), view.device).unsqueeze(0)
            quat_E4 = view.world.xquat_EL[:, view.bodies(self.body)].squeeze(1)
            gravity_E3 = quaternion.rotate_inverse(quat_E4, down_13.expand(view.num_envs, 3))
        return torch.exp(-gravity_E3[:, :2].square().sum(-1) / self.std**2)


@dataclass(frozen=True, kw_only=True)
class Pose(RewardTerm):
    """exp(-mean_j((q_j - q0_j)^2 / std_j^2)) about the default pose, [E]; position stage.

    How far a joint may stray depends on the commanded speed s = |c_xy| + |c_z|: standing below `walking_threshold`,
    running from `running_threshold` on, walking between.

    Attributes:
        std_standing, std_walking, std_running: rad or m by joint; keys are regular expressions, and together they
            match each of `joints` once.
    """

    command: str
    std_standing: Mapping[str, float]
    std_walking: Mapping[str, float]
    std_running: Mapping[str, float]
    walking_threshold: float
    running_threshold: float
    joints: Patterns = ".*"

    def __post_init__(self) -> None:
        super().__post_init__()
        for field in ("std_standing", "std_walking", "std_running"):
            for pattern, std in getattr(self, field).items():
                check_in_range(f"{field}[{pattern!r}]", std, low=0.0, low_open=True)
        check_in_range("running_threshold", self.running_threshold, low=self.walking_threshold)

    def __call__(self, view: EnvView) -> Tensor:
        """Return the unweighted reward, [E]."""
        speed_E1 = commanded_speed(view, self.command).unsqueeze(-1)
        std_EL = torch.where(
            speed_E1 < self.walking_threshold,
            self._std(view, "std_standing"),
            torch.where(
                speed_E1 < self.running_threshold,
                self._std(view, "std_walking"),
                self._std(view, "std_running"),
            ),
        )
        error_EL = view.joint_pos_rel_EL[:, view.joints(self.joints)]
        return torch.exp(-(error_EL / std_EL).square().mean(-1))

    def _std(self, view: EnvView, field: str) -> Tensor:
        names = view.joint_names(self.joints)
        return constant(values_by_name(field, getattr(self, field), names), view.device)


@dataclass(frozen=True, kw_only=True)
class JointPosLimits(RewardTerm):
    """Sum over joints of how far each is beyond its soft limits, rad or m, [E]; position stage.

    Soft limits: `scene.soft_joint_pos_limit_factor` of the range, about its middle.
    """

    joints: Patterns = ".*"

    def __call__(self, view: EnvView) -> Tensor:
        """Return the unweighted reward, [E]."""
        index = view.joints(self.joints)
        pos_EL, limits_L2 = view.joint_pos_EL[:, index], view.soft_joint_pos_limits_L2[index]
        below_EL = (limits_L2[:, 0] - pos_EL).clamp(min=0.0)
        above_EL = (pos_EL - limits_L2[:, 1]).clamp(min=0.0)
        return (below_EL + above_EL).sum(-1)


@dataclass(frozen=True, kw_only=True)
class BodyAngularVelocity(RewardTerm):
    """|w_xy|^2, `w` a body's angular velocity in the world frame, (rad/s)^2, [E]; velocity stage. Yaw is free."""

    body: str

    def __call__(self, view: EnvView) -> Tensor:
        """Return the unweighted reward, [E]."""
        return view.body_ang_vel_w(view.bodies(self.body))[..., :2].square().sum((-2, -1))


@dataclass(frozen=True, kw_only=True)
class AngularMomentum(RewardTerm):
    """|L|^2 of a `subtreeangmom` sensor, about the subtree's centre of mass, (kg m^2/s)^2, [E]; velocity stage."""

    sensor: str

    def __call__(self, view: EnvView) -> Tensor:
        """Return the unweighted reward, [E]."""
        return view.sensor(self.sensor).square().sum(-1)
