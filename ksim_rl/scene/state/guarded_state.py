"""This module guards the worlds' state: writes go through masks, and what they made stale cannot be read."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from ksim_rl.physics import World
from ksim_rl.scene.names import Index
from ksim_rl.scene.state.ground import Ground


class GuardedState:
    """Gives out the world for reading and writing, and knows whether derived quantities still fit the state.

    Attributes:
        ground: what heights are measured from.
        reader: who reads at the moment, for the error about stale quantities.
        is_frozen: whether construction has ended.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.ground = Ground(world.num_envs, world.device)
        self.reader = ""
        self.is_frozen = False
        self._is_stale = False
        self._caches: list[dict[str, Tensor]] = []
        self._body_root = torch.tensor(world.mj_model.body_rootid, device=world.device, dtype=torch.int64)

    def new_cache(self) -> dict[str, Shaped[Tensor, "*?shape"]]:
        """Return a dict for quantities that is emptied whenever the state changes."""
        self._caches.append({})
        return self._caches[-1]

    def derived(self) -> World:
        """Return the world for reading what derives from the state.

        Raises:
            RuntimeError: if a write has made that stale.
        """
        if self._is_stale:
            raise RuntimeError(
                f"{self.reader or 'a term'} reads a derived quantity (pose of a body or site, sensor) after state was "
                "written in the same moment: read it before writing, or from the joint state"
            )
        return self.world

    def refreshed(self) -> None:
        """Forget computed quantities: the state has changed, and the world has refreshed what derives from it."""
        self.forget()
        self._is_stale = False

    def changed(self) -> None:
        """Forget computed quantities: the state has changed, and what derives from it has not followed yet."""
        self.forget()
        self._is_stale = True

    def write(
        self, target_EL: Float[Tensor, "E L"], mask_E: Bool[Tensor, " E"], value_EL: Float[Tensor, "E L"]
    ) -> None:
        """Copy the rows of `mask_E` into a view of the state."""
        target_EL.copy_(torch.where(mask_E[:, None], value_EL, target_EL))
        self.changed()

    def write_columns(
        self,
        state_EL: Float[Tensor, "E L"],
        columns: Index,
        mask_E: Bool[Tensor, " E"],
        value_EN: Float[Tensor, "E N"],
    ) -> None:
        """Copy the rows of `mask_E` into some columns of the state."""
        state_EL[:, columns] = torch.where(mask_E[:, None], value_EN, state_EL[:, columns])
        self.changed()

    def point_velocity(self, point_EN3: Float[Tensor, "E N 3"], body: Index) -> Float[Tensor, "E N 3"]:
        """Return the velocities of points fixed to bodies, world frame, m/s, [E, N, 3]."""
        # MuJoCo's cvel is (angular, linear) about the centre of mass of the body's kinematic tree.
        world = self.derived()
        cvel_EN6 = world.cvel_EL[:, body]
        lever_EN3 = point_EN3 - world.subtree_com_EL[:, self._body_root[body]]
        return cvel_EN6[..., 3:] + torch.linalg.cross(cvel_EN6[..., :3], lever_EN3)

    def forget(self) -> None:
        """Forget computed quantities, whether or not what derives from the state is current."""
        for cache in self._caches:
            cache.clear()
