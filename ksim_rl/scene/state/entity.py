"""Reads and moves one robot or object of a scene: its root, its joints, and where it starts."""

from collections.abc import Sequence

import mujoco
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.scene import quaternion
from ksim_rl.scene.names import scalar_joint_ids
from ksim_rl.scene.near_names import NearNames
from ksim_rl.scene.small_matrices import plane_normal
from ksim_rl.scene.state.elements import Bodies, Body, Joints
from ksim_rl.scene.state.quantity import quantity
from ksim_rl.scene.state.simulation import Simulation


class GroundScan(NearNames):
    """The ground at points about an entity's root that turn with its yaw only: `view.robot.ground_scan(points)`.

    Attributes:
        points: x (forward) and y (left) of each point from the root, m.
        cache: a dict of computed quantities; it is emptied whenever the state changes.
    """

    def __init__(
        self, state: Simulation, entity: "Entity", points: Sequence[tuple[float, float]]
    ) -> None:
        self.points = tuple(points)
        self.cache = state.new_cache()
        self._state = state
        self._entity = entity
        points_N2 = torch.tensor(self.points, device=state.world.device, dtype=torch.float32)
        self._x_N, self._y_N = points_N2.view(-1, 2).unbind(-1)

    @quantity
    def below_EN(self) -> Float[Tensor, "E N"]:
        """How far the ground is below the root's frame at each of the points, m; position stage."""
        # Turned with the yaw alone: a robot that pitches still looks straight down.
        sin_E1 = torch.sin(self._entity.heading_E)[:, None]
        cos_E1 = torch.cos(self._entity.heading_E)[:, None]
        root_E3 = self._entity.root_pos_EL
        x_EN = cos_E1 * self._x_N - sin_E1 * self._y_N
        y_EN = sin_E1 * self._x_N + cos_E1 * self._y_N
        points_EN2 = root_E3[:, None, :2] + torch.stack((x_EN, y_EN), dim=-1)
        return root_E3[:, 2:] - self._state.ground.heights(points_EN2)

    @quantity
    def normal_E3(self) -> Float[Tensor, "E 3"]:
        """The upward normal of the plane through the ground at the points, or z, world frame; position stage."""
        # In axes that turn with the root's yaw, where x and y of the points are constant.
        places_EN2 = torch.stack((self._x_N, self._y_N), dim=-1).expand(*self.below_EN.shape, 2)
        points_EN3 = torch.cat((places_EN2, -self.below_EN[..., None]), dim=-1)
        x_E, y_E, z_E = plane_normal(points_EN3).unbind(-1)
        sin_E = torch.sin(self._entity.heading_E)
        cos_E = torch.cos(self._entity.heading_E)
        return torch.stack((cos_E * x_E - sin_E * y_E, sin_E * x_E + cos_E * y_E, z_E), dim=-1)


class Entity(NearNames):
    """A robot or object, addressed by name: `view.entity("cube").root_pos_EL`.

    Attributes:
        name: its key in `scene.robots` or `scene.objects`.
        prefix: the beginning of its elements' names; empty if it is alone in the scene.
        free_root: whether its first joint is free.
        root: the body of its first joint if that is free, else its first body.
        root_bodies: the same, as the only one of several bodies.
        root_qpos, root_qvel: columns of the free joint in MuJoCo's state, empty if the root is fixed.
        joints: its hinges and slides.
        default_root_pos_L: position of the root at reset, m, world frame.
        default_root_quat_L: orientation of the root at reset, body to world, (w, x, y, z).
        cache: a dict of computed quantities; it is emptied whenever the state changes.
    """

    def __init__(
        self,
        state: Simulation,
        *,
        name: str,
        prefix: str,
        default_qpos_L: Float[Tensor, " L"],
        every_joint: Joints,
    ) -> None:
        self.cache = state.new_cache()
        self._state = state
        model = state.world.mj_model
        device = state.world.device
        self.name = name
        self.prefix = prefix
        # Kinematic trees of the entity, by the prefix of their root bodies; body 0 is the world.
        all_roots = set(model.body_rootid[1:].tolist())
        roots = {root for root in all_roots if model.body(root).name.startswith(prefix)}
        # All bodies of these trees: parts of an attached model may have names without the prefix.
        bodies = [b for b in range(1, model.nbody) if model.body_rootid[b] in roots]
        if prefix and not bodies:
            raise ValueError(
                f"scene: {name!r} has no body: give it one, or put its geoms into the terrain"
            )
        joints = [j for j in range(model.njnt) if model.body_rootid[model.jnt_bodyid[j]] in roots]
        # MuJoCo allows a free joint as a body's first and only joint.
        self.free_root = bool(joints) and model.jnt_type[joints[0]] == mujoco.mjtJoint.mjJNT_FREE
        if self.free_root:
            root = int(model.jnt_bodyid[joints[0]])
        else:
            # A model without bodies leaves the world itself as the root.
            root = (bodies or [0])[0]
        self.root_bodies = Bodies(state, [root], [model.body(root).name])
        self.root = Body(self.root_bodies)
        self._scans: dict[tuple[tuple[float, float], ...], GroundScan] = {}
        self.root_qpos = slice(0, 0)
        self.root_qvel = slice(0, 0)
        # A fixed root stands where its model puts it, relative to its parent.
        pose = torch.tensor([*model.body_pos[root], *model.body_quat[root]], device=device)
        if self.free_root:
            qpos = int(model.jnt_qposadr[joints[0]])
            qvel = int(model.jnt_dofadr[joints[0]])
            # MuJoCo's layout: 3 of position and 4 of quaternion; velocities are 3 linear and 3 angular.
            self.root_qpos = slice(qpos, qpos + 7)
            self.root_qvel = slice(qvel, qvel + 6)
            pose = default_qpos_L[self.root_qpos]
        self.default_root_pos_L, self.default_root_quat_L = pose.to(torch.float32).split((3, 4))
        self._down = torch.tensor([0.0, 0.0, -1.0], device=device)
        self.joints = every_joint.some(
            [i for i, j in enumerate(scalar_joint_ids(model)) if j in joints]
        )

    @quantity
    def root_pos_EL(self) -> Float[Tensor, "E 3"]:
        """Position of the root body's frame, m, world frame; position stage."""
        # From the state itself, which is current also between a write and the next refresh.
        if self.free_root:
            return self._free_qpos_EL[:, :3]
        return self.root.pos_EL

    @quantity
    def root_quat_EL(self) -> Float[Tensor, "E 4"]:
        """Orientation of the root body, body to world, (w, x, y, z); position stage."""
        if self.free_root:
            return self._free_qpos_EL[:, 3:]
        return self.root.quat_EL

    @quantity
    def projected_gravity_EL(self) -> Float[Tensor, "E 3"]:
        """Gravity's direction (world -z), a unit vector, body frame; position stage."""
        # The world's -z axis, also where a world's gravity points elsewhere.
        return quaternion.rotate_inverse(
            self.root_quat_EL, self._down.expand(self._state.world.num_envs, 3)
        )

    @quantity
    def heading_E(self) -> Float[Tensor, " E"]:
        """Yaw of the root body in [-pi, pi], rad; position stage."""
        return quaternion.yaw(self.root_quat_EL)

    @quantity
    def root_lin_vel_w_EL(self) -> Float[Tensor, "E 3"]:
        """Linear velocity of the root body's frame origin, m/s, world frame; velocity stage."""
        # MuJoCo keeps a free joint's linear velocity in the world frame.
        if self.free_root:
            return self._free_qvel_EL[:, :3]
        return self.root.lin_vel_EL

    @quantity
    def root_lin_vel_b_EL(self) -> Float[Tensor, "E 3"]:
        """Linear velocity of the root body's frame origin, m/s, body frame; velocity stage."""
        return quaternion.rotate_inverse(self.root_quat_EL, self.root_lin_vel_w_EL)

    @quantity
    def root_ang_vel_w_EL(self) -> Float[Tensor, "E 3"]:
        """Angular velocity of the root body, rad/s, world frame; velocity stage."""
        # The other way round than above: qvel has it in the body frame.
        if self.free_root:
            return quaternion.rotate(self.root_quat_EL, self.root_ang_vel_b_EL)
        return self.root.ang_vel_EL

    @quantity
    def root_ang_vel_b_EL(self) -> Float[Tensor, "E 3"]:
        """Angular velocity of the root body, rad/s, body frame; velocity stage."""
        if self.free_root:  # MuJoCo keeps a free joint's angular velocity in the body frame
            return self._free_qvel_EL[:, 3:]
        return quaternion.rotate_inverse(self.root_quat_EL, self.root_ang_vel_w_EL)

    @quantity
    def root_height_E(self) -> Float[Tensor, " E"]:
        """Height of the root body's frame above the ground right below it, m; position stage."""
        # `clearance` takes [E, N, 3]; the root is a single point per env.
        return self._state.ground.clearance(self.root_pos_EL[:, None])[:, 0]

    def ground_scan(self, points: tuple[tuple[float, float], ...]) -> GroundScan:
        """Return the ground at points (x, y) about the root, m; it is made once, while the env is constructed."""
        if points not in self._scans:
            self._scans[points] = GroundScan(self._state, self, points)
        return self._scans[points]

    @property
    def ground_scans(self) -> list[GroundScan]:
        """All scans that terms have asked for."""
        return list(self._scans.values())

    def write_root_pose(
        self,
        mask_E: Bool[Tensor, " E"],
        pos_EL: Float[Tensor, "E 3"],
        quat_EL: Float[Tensor, "E 4"],
    ) -> None:
        """Set position (m) and orientation (w, x, y, z) of the free root body in the rows of `mask_E`."""
        self._require_free_root("write_root_pose")
        pose_EL = torch.cat((pos_EL, quat_EL), dim=-1)
        self._state.write(self._state.world.qpos_EL, self.root_qpos, mask_E, pose_EL)

    def write_root_velocity(
        self,
        mask_E: Bool[Tensor, " E"],
        lin_vel_w_EL: Float[Tensor, "E 3"],
        ang_vel_w_EL: Float[Tensor, "E 3"],
    ) -> None:
        """Set the velocities (m/s, rad/s, world frame) of the free root body in the rows of `mask_E`."""
        self._require_free_root("write_root_velocity")
        # With the orientation that is in qpos now: write the pose first, then the velocity.
        ang_vel_b_EL = quaternion.rotate_inverse(self._free_qpos_EL[:, 3:], ang_vel_w_EL)
        velocity_EL = torch.cat((lin_vel_w_EL, ang_vel_b_EL), dim=-1)
        self._state.write(self._state.world.qvel_EL, self.root_qvel, mask_E, velocity_EL)

    @property
    def _free_qpos_EL(self) -> Tensor:
        return self._state.world.qpos_EL[:, self.root_qpos]

    @property
    def _free_qvel_EL(self) -> Tensor:
        return self._state.world.qvel_EL[:, self.root_qvel]

    def _require_free_root(self, what: str) -> None:
        if not self.free_root:
            raise ValueError(
                f"{what} of {self.name!r}: its root body {self.root.name!r} has no free joint; this needs a robot or "
                "object whose first joint is free"
            )
