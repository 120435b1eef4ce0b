"""Rewards for following a command: a velocity (vx, vy, wz) in the root's frame, a height, a pose, joint positions."""

from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from ksim_rl.checks import check_choice
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.commands.target_pose import (
    FRAMES,
    check_one_point,
    distance_to_target,
    target_pose_w,
)
from ksim_rl.mdp.rewards.gaussian_reward import GaussianReward
from ksim_rl.mdp.root_height import root_height
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns

# -- velocity ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class TrackLinearVelocity(GaussianReward):
    """exp(-(|c_xy - v_xy|^2 + v_z^2) / std^2), `v` the root's linear velocity in its own frame, m/s, [E].

    Attributes:
        entity: the robot that follows; "" is the first one.
    """

    command: str
    entity: str = ""

    def __call__(self, view: EnvView) -> Tensor:
        """Return the unweighted reward, [E]."""
        vel_E3 = view.entity(self.entity).root_lin_vel_b_EL
        error_E2 = view.command(self.command)[:, :2] - vel_E3[:, :2]
        return self.rate(error_E2.square().sum(-1) + vel_E3[:, 2].square())


@dataclass(frozen=True, kw_only=True)
class TrackAngularVelocity(GaussianReward):
    """exp(-((c_z - w_z)^2 + |w_xy|^2) / std^2), `w` the root's angular velocity in its own frame, rad/s, [E].

    Attributes:
        entity: the robot that follows; "" is the first one.
    """

    command: str
    entity: str = ""

    def __call__(self, view: EnvView) -> Tensor:
        """Return the unweighted reward, [E]."""
        vel_E3 = view.entity(self.entity).root_ang_vel_b_EL
        error_E = view.command(self.command)[:, 2] - vel_E3[:, 2]
        return self.rate(error_E.square() + vel_E3[:, :2].square().sum(-1))


# -- height, pose, joints ----------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class TrackRootHeight(GaussianReward):
    """exp(-(c - h)^2 / std^2), `h` the height of the root body's frame above the ground, m, [E]; position stage.

    Attributes:
        command: a height, m, such as `BaseHeightCommand`.
        entity: the robot that follows; "" is the first one.
    """

    command: str
    entity: str = ""

    def __call__(self, view: EnvView) -> Tensor:
        """Return the unweighted reward, [E]."""
        error_E = view.command(self.command)[:, 0] - root_height(view, self.entity)
        return self.rate(error_E.square())


@dataclass(frozen=True, kw_only=True)
class TrackPosition(GaussianReward):
    """exp(-d^2 / std^2), `d` the distance of a body or site from the commanded position, m, [E]; position stage.

    Attributes:
        command: a position, and an orientation or not, such as `CartesianCommand` or `StartPoseCommand`.
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
        super().__post_init__()
        check_one_point(self.body, self.site)
        check_choice("frame", self.frame, FRAMES)

    def __call__(self, view: EnvView) -> Tensor:
        """Return the unweighted reward, [E]."""
        distance_E = distance_to_target(
            view, self.command, frame=self.frame, body=self.body, site=self.site, entity=self.entity
        )
        return self.rate(distance_E.square())


@dataclass(frozen=True, kw_only=True)
class TrackOrientation(GaussianReward):
    """exp(-a^2 / std^2), `a` the angle between a body and the commanded orientation, rad, [E]; position stage.

    Attributes:
        command: a pose, position and quaternion [E, 7], such as `CartesianCommand` or `StartPoseCommand`.
        body: what should have that orientation.
        frame: that of the command.
        entity: whose root that frame is; "" is the first robot.
    """

    command: str
    body: str
    frame: Literal["root", "world"] = "root"
    entity: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("frame", self.frame, FRAMES)

    def __call__(self, view: EnvView) -> Tensor:
        """Return the unweighted reward, [E].

        Raises:
            ValueError: if the command has no orientation.
        """
        command_EK = view.command(self.command)
        _, target_E4 = target_pose_w(view, command_EK, frame=self.frame, entity=self.entity)
        if target_E4 is None:
            raise ValueError(
                f"command={self.command!r} has {command_EK.shape[1]} numbers: expected position and quaternion"
            )
        quat_E4 = view.bodies(self.body).quat_EN4[:, 0]
        return self.rate(quaternion.angle_between(quat_E4, target_E4).square())


@dataclass(frozen=True, kw_only=True)
class TrackJointPosition(GaussianReward):
    """exp(-mean_j((c_j - q_j)^2) / std^2), rad or m, [E]; position stage.

    Attributes:
        command: positions of `joints`, in their order, such as `JointPositionCommand`.
    """

    command: str
    joints: Patterns = ".*"

    def __call__(self, view: EnvView) -> Tensor:
        """Return the unweighted reward, [E]."""
        error_EL = view.command(self.command) - view.joints(self.joints).pos_EL
        return self.rate(error_EL.square().mean(-1))
