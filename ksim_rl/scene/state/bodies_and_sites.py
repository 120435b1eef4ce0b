"""This module gives terms the bodies and sites that they name: `view.body("torso").lin_vel_EL`."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.scene.names import as_index
from ksim_rl.scene.state.guarded_state import GuardedState
from ksim_rl.scene.state.quantity import quantity


class _Points:
    """Named elements of one kind, in the order of the patterns that match them; N of them.

    Quantities are float32, of the current state, in the world frame, and computed at most once per state, whoever
    reads them.

    Attributes:
        names: of the elements.
        ids: theirs in the model.
        index: the same, to index the dim of this kind: a slice, or int64 on the device.
    """

    def __init__(self, state: GuardedState, ids: Sequence[int], names: Sequence[str]) -> None:
        self.ids, self.names = tuple(ids), list(names)
        self.index = as_index(ids, state.world.device)
        self.cache = state.new_cache()
        self._state = state

    def __len__(self) -> int:
        return len(self.ids)


class Bodies(_Points):
    """The bodies that some patterns match: `view.bodies(".*_foot").pos_EN3`."""

    @quantity
    def pos_EN3(self) -> Float[Tensor, "E N 3"]:
        """Positions of the body frames, m."""
        return self._state.derived().xpos_EL[:, self.index]

    @quantity
    def quat_EN4(self) -> Float[Tensor, "E N 4"]:
        """Orientations, body to world, (w, x, y, z)."""
        return self._state.derived().xquat_EL[:, self.index]

    @quantity
    def axes_EN33(self) -> Float[Tensor, "E N 3 3"]:
        """The x, y and z axes of the bodies, a unit vector each: [E, N, axis, 3]."""
        return self._state.derived().xmat_EL[:, self.index].transpose(-1, -2)

    @quantity
    def lin_vel_EN3(self) -> Float[Tensor, "E N 3"]:
        """Linear velocities of the origins of the body frames, m/s."""
        return self._state.point_velocity(self.pos_EN3, self.index)

    @quantity
    def ang_vel_EN3(self) -> Float[Tensor, "E N 3"]:
        """Angular velocities, rad/s."""
        return self._state.derived().cvel_EL[:, self.index, 0:3]

    @quantity
    def subtree_com_pos_EN3(self) -> Float[Tensor, "E N 3"]:
        """Centres of mass of the bodies with all that hangs on them, m."""
        return self._state.derived().subtree_com_EL[:, self.index]

    @quantity
    def subtree_com_vel_EN3(self) -> Float[Tensor, "E N 3"]:
        """Velocities of the centres of mass of the bodies with all that hangs on them, m/s.

        Raises:
            RuntimeError: if no term asked for them while the env was constructed.
        """
        world = self._state.derived()
        if not self._state.is_frozen:
            world.refresh_subtree_velocities()
        elif not world.has_subtree_velocities:
            raise RuntimeError("subtree velocities are not computed: let a term of the config read them")
        return world.view("subtree_linvel")[:, self.index]


class Body:
    """One body: `view.body("torso").lin_vel_EL`; the world frame, as in `Bodies`.

    Attributes:
        name, id: in the model.
    """

    def __init__(self, bodies: Bodies) -> None:
        (self.name,), (self.id,) = bodies.names, bodies.ids
        self._bodies = bodies

    @property
    def pos_EL(self) -> Float[Tensor, "E 3"]:
        """Position of the body frame, m."""
        return self._bodies.pos_EN3[:, 0]

    @property
    def quat_EL(self) -> Float[Tensor, "E 4"]:
        """Orientation, body to world, (w, x, y, z)."""
        return self._bodies.quat_EN4[:, 0]

    @property
    def axes_E33(self) -> Float[Tensor, "E 3 3"]:
        """The x, y and z axis, a unit vector each: [E, axis, 3]."""
        return self._bodies.axes_EN33[:, 0]

    @property
    def lin_vel_EL(self) -> Float[Tensor, "E 3"]:
        """Linear velocity of the origin of the body frame, m/s."""
        return self._bodies.lin_vel_EN3[:, 0]

    @property
    def ang_vel_EL(self) -> Float[Tensor, "E 3"]:
        """Angular velocity, rad/s."""
        return self._bodies.ang_vel_EN3[:, 0]


class Sites(_Points):
    """The sites that some patterns match: `view.sites(".*_foot").height_EN`."""

    def __init__(self, state: GuardedState, ids: Sequence[int], names: Sequence[str]) -> None:
        super().__init__(state, ids, names)
        bodies = [int(state.world.mj_model.site_bodyid[i]) for i in ids]
        self._bodies = torch.tensor(bodies, device=state.world.device, dtype=torch.int64)

    @quantity
    def pos_EN3(self) -> Float[Tensor, "E N 3"]:
        """Positions, m."""
        return self._state.derived().site_xpos_EL[:, self.index]

    @quantity
    def height_EN(self) -> Float[Tensor, "E N"]:
        """Heights above the ground right below, m."""
        return self._state.ground.clearance(self.pos_EN3)

    @quantity
    def lin_vel_EN3(self) -> Float[Tensor, "E N 3"]:
        """Linear velocities, m/s."""
        return self._state.point_velocity(self.pos_EN3, self._bodies)


class Site:
    """One site: `view.site("finger").pos_EL`; the world frame, as in `Sites`.

    Attributes:
        name, id: in the model.
    """

    def __init__(self, sites: Sites) -> None:
        (self.name,), (self.id,) = sites.names, sites.ids
        self._sites = sites

    @property
    def pos_EL(self) -> Float[Tensor, "E 3"]:
        """Position, m."""
        return self._sites.pos_EN3[:, 0]

    @property
    def height_E(self) -> Float[Tensor, " E"]:
        """Height above the ground right below, m."""
        return self._sites.height_EN[:, 0]

    @property
    def lin_vel_EL(self) -> Float[Tensor, "E 3"]:
        """Linear velocity, m/s."""
        return self._sites.lin_vel_EN3[:, 0]
