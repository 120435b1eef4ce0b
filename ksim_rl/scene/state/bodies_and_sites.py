"""Poses and velocities of bodies and sites."""

from torch import Tensor

from ksim_rl.scene.names import Index
from ksim_rl.scene.state.guarded_state import GuardedState
from ksim_rl.scene.state.memory import Memory
from ksim_rl.scene.state.quantity import indexed_quantity
from ksim_rl.scene.terrains.ground import Ground


class BodiesAndSites:
    """The part of `EnvView` that reads bodies and sites by index (`view.bodies`, `view.sites`).

    Each is computed at most once per index and state, whoever reads it; all are of the current state.
    """

    cache: dict[str, Tensor]
    memories: Memory
    terrain: Ground
    _state: GuardedState
    _site_body: Tensor

    @indexed_quantity
    def body_pos_w(self, index: Index) -> Tensor:
        """Return positions of body frames in the world, m, [E, N, 3]."""
        return self._state.derived().xpos_EL[:, index]

    @indexed_quantity
    def body_quat_w(self, index: Index) -> Tensor:
        """Return orientations of bodies, body to world, (w, x, y, z), [E, N, 4]."""
        return self._state.derived().xquat_EL[:, index]

    @indexed_quantity
    def body_axes_w(self, index: Index) -> Tensor:
        """Return the x, y and z axes of bodies, unit vectors in the world, [E, N, axis 3, 3]."""
        return self._state.derived().xmat_EL[:, index].transpose(-1, -2)

    @indexed_quantity
    def body_lin_vel_w(self, index: Index) -> Tensor:
        """Return linear velocities of body frame origins, world frame, m/s, [E, N, 3]."""
        return self._state.point_velocity(self.body_pos_w(index), index)

    @indexed_quantity
    def body_ang_vel_w(self, index: Index) -> Tensor:
        """Return angular velocities of bodies, world frame, rad/s, [E, N, 3]."""
        return self._state.derived().cvel_EL[:, index, 0:3]

    @indexed_quantity
    def subtree_com_pos_w(self, index: Index) -> Tensor:
        """Return centres of mass of bodies with all that hangs on them, world frame, m, [E, N, 3]."""
        return self._state.derived().subtree_com_EL[:, index]

    @indexed_quantity
    def subtree_com_vel_w(self, index: Index) -> Tensor:
        """Return velocities of centres of mass of bodies with all that hangs on them, world frame, m/s, [E, N, 3].

        Raises:
            RuntimeError: if no term asked for them while the env was constructed.
        """
        world = self._state.derived()
        if not self.memories.is_frozen:
            world.refresh_subtree_velocities()
        elif not world.has_subtree_velocities:
            raise RuntimeError("subtree velocities are not computed: let a term of the config read them")
        return world.view("subtree_linvel")[:, index]

    @indexed_quantity
    def site_pos_w(self, index: Index) -> Tensor:
        """Return positions of sites in the world, m, [E, N, 3]."""
        return self._state.derived().site_xpos_EL[:, index]

    @indexed_quantity
    def site_height(self, index: Index) -> Tensor:
        """Return heights of sites above the ground right below them, m, [E, N]."""
        return self.terrain.clearance(self.site_pos_w(index))

    @indexed_quantity
    def site_lin_vel_w(self, index: Index) -> Tensor:
        """Return linear velocities of sites, world frame, m/s, [E, N, 3]."""
        return self._state.point_velocity(self.site_pos_w(index), self._site_body[index])
