"""Gives terms the joints, bodies and sites that they name: `view.joints("hip.*").pos_EL`."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.scene.names import as_index, scalar_joint_ids
from ksim_rl.scene.near_names import NearNames
from ksim_rl.scene.state.quantity import first_of, quantity
from ksim_rl.scene.state.simulation import Simulation


class _Elements(NearNames):
    """N named elements of one kind, in the order of the patterns that match them.

    Attributes:
        names: their names, in this order.
        ids: their ids in the model, of joints among its hinges and slides.
        index: the same, a slice or int64 on the device, to index the dim of this kind.
        cache: a dict of computed quantities; it is emptied whenever the state changes.
    """

    def __init__(self, state: Simulation, ids: Sequence[int], names: Sequence[str]) -> None:
        self.ids = tuple(ids)
        self.names = list(names)
        self.index = as_index(ids, state.world.device)
        self.cache = state.new_cache()
        self._state = state

    def __len__(self) -> int:
        return len(self.ids)


class JointTables(NamedTuple):
    """Default positions, soft limits (low, high), and excess readings of encoders, rad or m; events may write them."""

    default_pos_EL: Float[Tensor, "E L"]
    soft_limits_L2: Float[Tensor, "L 2"]
    encoder_bias_EL: Float[Tensor, "E L"]


class Joints(_Elements):
    """The hinges (rad) and slides (m) that some patterns match: `view.joints("hip.*").pos_EL`.

    Attributes:
        qpos, qvel: their columns in MuJoCo's state.
    """

    def __init__(
        self,
        state: Simulation,
        ids: Sequence[int],
        names: Sequence[str],
        tables: JointTables,
        every_joint: "Joints | None" = None,
    ) -> None:
        super().__init__(state, ids, names)
        model = state.world.mj_model
        device = state.world.device
        scalar = scalar_joint_ids(model)
        self._tables = tables
        # Without one, it is all joints itself.
        self._every_joint = every_joint or self
        self.qpos = as_index([model.jnt_qposadr[scalar[i]] for i in ids], device)
        self.qvel = as_index([model.jnt_dofadr[scalar[i]] for i in ids], device)

    def some(self, ids: Sequence[int]) -> "Joints":
        """Return the joints at some places among the model's hinges and slides; for all joints only."""
        # Ids count all hinges and slides, which a part does not know.
        assert self is self._every_joint
        return Joints(self._state, ids, [self.names[i] for i in ids], self._tables, self)

    @quantity
    def pos_EL(self) -> Float[Tensor, "E L"]:
        """Positions, rad or m; position stage."""
        return self._state.world.qpos_EL[:, self.qpos]

    @quantity
    def vel_EL(self) -> Float[Tensor, "E L"]:
        """Velocities, rad/s or m/s; velocity stage."""
        return self._state.world.qvel_EL[:, self.qvel]

    @quantity
    def acc_EL(self) -> Float[Tensor, "E L"]:
        """Accelerations, rad/s^2 or m/s^2; acceleration stage."""
        # From the last substep: a write of the state does not change it.
        return self._state.world.qacc_EL[:, self.qvel]

    @quantity
    def effort_EL(self) -> Float[Tensor, "E L"]:
        """The effort of actuators, N m or N, behind the gears; acceleration stage."""
        # MuJoCo's sum over all actuators of the joint, after the gears and the joint's own limit.
        return self._state.world.qfrc_actuator_EL[:, self.qvel]

    @quantity
    def pos_rel_EL(self) -> Float[Tensor, "E L"]:
        """Positions minus the default pose, rad or m; position stage."""
        # Computed once for all joints; parts take columns.
        if self is self._every_joint:
            return self.pos_EL - self._tables.default_pos_EL
        return self._every_joint.pos_rel_EL[:, self.index]

    @property
    def default_pos_EL(self) -> Float[Tensor, "E L"]:
        """Positions in the default pose, rad or m, which events may move."""
        return self._tables.default_pos_EL[:, self.index]

    @property
    def soft_limits_L2(self) -> Float[Tensor, "L 2"]:
        """Ends of `scene.soft_joint_pos_limit_factor` of each range, rad or m, infinite where there is none."""
        return self._tables.soft_limits_L2[self.index]

    @property
    def encoder_bias_EL(self) -> Float[Tensor, "E L"]:
        """The encoders' readings less the positions, rad or m."""
        return self._tables.encoder_bias_EL[:, self.index]

    @property
    def encoder_pos_EL(self) -> Float[Tensor, "E L"]:
        """The readings of the encoders, rad or m; position stage."""
        return self.pos_EL + self.encoder_bias_EL

    def write_pos(self, mask_E: Bool[Tensor, " E"], pos_EL: Float[Tensor, "E L"]) -> None:
        """Set the positions in the rows of `mask_E`."""
        self._state.write(self._state.world.qpos_EL, self.qpos, mask_E, pos_EL)

    def write_vel(self, mask_E: Bool[Tensor, " E"], vel_EL: Float[Tensor, "E L"]) -> None:
        """Set the velocities in the rows of `mask_E`."""
        self._state.write(self._state.world.qvel_EL, self.qvel, mask_E, vel_EL)


class Bodies(_Elements):
    """The bodies that some patterns match: `view.bodies(".*_foot").pos_EN3`."""

    @quantity
    def pos_EN3(self) -> Float[Tensor, "E N 3"]:
        """Positions of the body frames, m, world frame; position stage."""
        return self._state.derived().xpos_EL[:, self.index]

    @quantity
    def quat_EN4(self) -> Float[Tensor, "E N 4"]:
        """Orientations, body to world, (w, x, y, z); position stage."""
        return self._state.derived().xquat_EL[:, self.index]

    @quantity
    def axes_EN33(self) -> Float[Tensor, "E N 3 3"]:
        """The x, y and z axes of the bodies, a unit vector each, world frame; position stage."""
        # MuJoCo's matrix has the axes as columns; rows are easier to pick.
        return self._state.derived().xmat_EL[:, self.index].transpose(-1, -2)

    @quantity
    def lin_vel_EN3(self) -> Float[Tensor, "E N 3"]:
        """Linear velocities of the origins of the body frames, m/s, world frame; velocity stage."""
        return self._state.point_velocity(self.pos_EN3, self.index)

    @quantity
    def ang_vel_EN3(self) -> Float[Tensor, "E N 3"]:
        """Angular velocities, rad/s, world frame; velocity stage."""
        # `cvel` is angular first, linear second.
        return self._state.derived().cvel_EL[:, self.index, 0:3]

    @quantity
    def inertia_EN10(self) -> Float[Tensor, "E N 10"]:
        """Inertias about the centres of mass of the bodies' trees, as MuJoCo's `cinert` has them; position stage."""
        return self._state.derived().view("cinert")[:, self.index]

    @quantity
    def subtree_com_pos_EN3(self) -> Float[Tensor, "E N 3"]:
        """Centres of mass of the bodies with all that hangs on them, m, world frame; position stage."""
        return self._state.derived().subtree_com_EL[:, self.index]

    @quantity
    def subtree_com_vel_EN3(self) -> Float[Tensor, "E N 3"]:
        """Velocities of these centres of mass, m/s, world frame; velocity stage; first read in construction."""
        # A sensor stage of MuJoCo, computed only if something asked for it in construction.
        return self._state.derived().view("subtree_linvel")[:, self.index]


class Body(NearNames):
    """One body: `view.body("torso").lin_vel_EL`.

    Attributes:
        name: its name.
        id: its index in the model.
    """

    def __init__(self, bodies: Bodies) -> None:
        # Exactly one, or unpacking fails.
        (self.name,) = bodies.names
        (self.id,) = bodies.ids
        self._bodies = bodies

    pos_EL = first_of("_bodies", Bodies.pos_EN3)
    quat_EL = first_of("_bodies", Bodies.quat_EN4)
    axes_E33 = first_of("_bodies", Bodies.axes_EN33)
    lin_vel_EL = first_of("_bodies", Bodies.lin_vel_EN3)
    ang_vel_EL = first_of("_bodies", Bodies.ang_vel_EN3)


class Sites(_Elements):
    """The sites that some patterns match: `view.sites(".*_foot").height_EN`."""

    def __init__(self, state: Simulation, ids: Sequence[int], names: Sequence[str]) -> None:
        super().__init__(state, ids, names)
        bodies = [int(state.world.mj_model.site_bodyid[i]) for i in ids]
        # Velocities of sites follow from their bodies'.
        self._bodies = torch.tensor(bodies, device=state.world.device, dtype=torch.int64)

    @quantity
    def pos_EN3(self) -> Float[Tensor, "E N 3"]:
        """Positions, m, world frame; position stage."""
        return self._state.derived().site_xpos_EL[:, self.index]

    @quantity
    def axes_EN33(self) -> Float[Tensor, "E N 3 3"]:
        """The x, y and z axes of the sites, a unit vector each, world frame; position stage."""
        # MuJoCo's matrix has the axes as columns, like a body's matrix.
        return self._state.derived().site_xmat_EL[:, self.index].view(-1, len(self), 3, 3).mT

    @quantity
    def height_EN(self) -> Float[Tensor, "E N"]:
        """Heights above the ground right below, m; position stage."""
        return self._state.ground.clearance(self.pos_EN3)

    @quantity
    def lin_vel_EN3(self) -> Float[Tensor, "E N 3"]:
        """Linear velocities, m/s, world frame; velocity stage."""
        return self._state.point_velocity(self.pos_EN3, self._bodies)

    @property
    def lin_vel_of_contacts_EN3(self) -> Float[Tensor, "E N 3"]:
        """Linear velocities at the moment that contacts belong to, m/s; acceleration stage; first read in construction.

        A foot that hits the ground has lost its velocity at the end of that substep, and has it here.
        """
        return self._state.site_velocity_of_contacts(
            f"sites {list(self.ids)}", self.index, self._bodies, count=len(self)
        )


class Site(NearNames):
    """One site: `view.site("finger").pos_EL`.

    Attributes:
        name: its name.
        id: its index in the model.
    """

    def __init__(self, sites: Sites) -> None:
        (self.name,) = sites.names
        (self.id,) = sites.ids
        self._sites = sites

    pos_EL = first_of("_sites", Sites.pos_EN3)
    height_E = first_of("_sites", Sites.height_EN)
    lin_vel_EL = first_of("_sites", Sites.lin_vel_EN3)
