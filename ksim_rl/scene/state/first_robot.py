"""This module lets terms write `view.root_pos_EL` for the first robot, and most scenes have no other."""

from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.scene.state.entity import Entity


class FirstRobot:
    """The part of `EnvView` that is `view.entity("")`, written shorter."""

    robot: Entity

    @property
    def root_pos_EL(self) -> Float[Tensor, "E 3"]:
        """Position of the first robot's root body frame in the world, m, [E, 3]."""
        return self.robot.root_pos_EL

    @property
    def root_quat_EL(self) -> Float[Tensor, "E 4"]:
        """Orientation of the first robot's root body, body to world, (w, x, y, z), [E, 4]."""
        return self.robot.root_quat_EL

    @property
    def root_lin_vel_w_EL(self) -> Float[Tensor, "E 3"]:
        """Linear velocity of the first robot's root body frame origin, world frame, m/s, [E, 3]."""
        return self.robot.root_lin_vel_w_EL

    @property
    def root_ang_vel_w_EL(self) -> Float[Tensor, "E 3"]:
        """Angular velocity of the first robot's root body, world frame, rad/s, [E, 3]."""
        return self.robot.root_ang_vel_w_EL

    @property
    def root_lin_vel_b_EL(self) -> Float[Tensor, "E 3"]:
        """Linear velocity of the first robot's root body frame origin, body frame, m/s, [E, 3]."""
        return self.robot.root_lin_vel_b_EL

    @property
    def root_ang_vel_b_EL(self) -> Float[Tensor, "E 3"]:
        """Angular velocity of the first robot's root body, body frame, rad/s, [E, 3]."""
        return self.robot.root_ang_vel_b_EL

    @property
    def projected_gravity_EL(self) -> Float[Tensor, "E 3"]:
        """Unit vector of gravity (world -z) in the first robot's root body frame, [E, 3]."""
        return self.robot.projected_gravity_EL

    @property
    def heading_E(self) -> Float[Tensor, " E"]:
        """Yaw of the first robot's root body, rad in [-pi, pi], [E]."""
        return self.robot.heading_E

    @property
    def free_root(self) -> bool:
        """Whether the first robot's root floats freely."""
        return self.robot.free_root

    def write_root_pose(
        self, mask_E: Bool[Tensor, " E"], pos_EL: Float[Tensor, "E 3"], quat_EL: Float[Tensor, "E 4"]
    ) -> None:
        """Set position (m) and orientation (w, x, y, z) of the first robot's free root in the rows of `mask_E`."""
        self.robot.write_root_pose(mask_E, pos_EL, quat_EL)

    def write_root_velocity(
        self,
        mask_E: Bool[Tensor, " E"],
        lin_vel_w_EL: Float[Tensor, "E 3"],
        ang_vel_w_EL: Float[Tensor, "E 3"],
    ) -> None:
        """Set velocities (m/s, rad/s, world frame) of the first robot's free root in the rows of `mask_E`."""
        self.robot.write_root_velocity(mask_E, lin_vel_w_EL, ang_vel_w_EL)
