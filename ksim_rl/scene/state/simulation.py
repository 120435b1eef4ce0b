"""Drives the worlds of an env: it knows when the state changes, whose turn it is, and which tensors are kept."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from ksim_rl.device import random
from ksim_rl.physics import World
from ksim_rl.scene.names import Index
from ksim_rl.scene.state.buffers import ENV, Buffers, Kept, SharedValues
from ksim_rl.scene.state.ground import Ground

UNWATCHED: AbstractContextManager[Mapping[str, Kept]] = nullcontext({})
"""The context that watches nothing."""


class Simulation:
    """The worlds with their clocks, buffers and draws, for whoever drives them; terms read a `WorldView` of it.

    A moment has two phases: state is written through masks (`changed`), then the world refreshes derived
    quantities (`refreshed`), which cannot be read in between. A term runs inside `scope`, which names its buffers.

    Attributes:
        ground: the ground that heights are measured from.
        reader: who reads at the moment, for the error about stale quantities.
        is_writing: whether `write` is at work, which is the only way to write positions and velocities.
        is_frozen: whether construction has ended.
        physics_dt, step_dt: s, of a substep and of an env step.
        max_episode_length: env steps; 0 for no limit.
        buffers, shared_values: tensors that are kept from step to step, with and without a row per env.
        seed, step_count: int64 []; of all draws, and how many env steps have begun.
        reset_count_E, episode_step_E: int64 [E]; how often each env was reset, and env steps since then.
        time_out_offset_E: int64 [E]; how many env steps earlier a staggered episode times out.
        before_substep, after_substep: called around each physics substep (see `World.step`), amid its changes of state.
        substep_sensors: at which substeps the world computes its sensors.
    """

    def __init__(self, world: World, *, step_dt: float, max_episode_length: int = 0) -> None:
        self.world = world
        self.num_envs = world.num_envs
        self.device = world.device
        # From the compiled model: `SimCfg` may have set another time step.
        self.physics_dt = float(world.mj_model.opt.timestep)
        self.step_dt = step_dt
        self.max_episode_length = max_episode_length
        self.ground = Ground(self.num_envs, self.device)
        self.buffers = Buffers(self.num_envs, self.device)
        self.shared_values = SharedValues(self.device)
        self.seed = torch.zeros((), dtype=torch.int64, device=self.device)
        self.step_count = torch.zeros_like(self.seed)
        self.reset_count_E = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        self.episode_step_E = torch.zeros_like(self.reset_count_E)
        # Kept by a manager, so that no term may write it.
        self.time_out_offset_E = self.buffers.get("time_out_offset_E", dtype=torch.int64, owner=ENV)
        self.before_substep: list[Callable[[], None]] = []
        self.after_substep: list[Callable[[], None]] = []
        self.substep_sensors: Literal["last", "contacts", "every"] = "last"
        # Draws before the first step have a counter to themselves.
        self.startup_counter = torch.zeros_like(self.seed)
        self.reader = ""
        self.is_frozen = False
        self._is_stale = False
        self._caches: list[dict[str, Tensor]] = []
        # The quantities that are kept from the moment of the contacts, and how each is read there.
        self._of_contacts: dict[str, tuple[Tensor, Callable[[], Tensor]]] = {}
        # The tree of each body; its centre of mass is the reference of `cvel`.
        self._body_root = torch.tensor(
            world.mj_model.body_rootid, device=self.device, dtype=torch.int64
        )
        self._counter = self.startup_counter
        self._scope = ""
        self._draw_scope = ""
        self._draws = 0
        self.is_writing = False

    def new_cache(self) -> dict[str, Any]:
        """Return a dict for quantities, tensors or tuples of them, that is emptied whenever the state changes."""
        self._caches.append({})
        return self._caches[-1]

    def derived(self) -> World:
        """Return the world for reading derived quantities; a RuntimeError if a write has made them stale."""
        # A stale quantity would be wrong in silence, and only in the rows that were written.
        if self._is_stale:
            raise RuntimeError(
                f"{self.reader or 'a term'} reads a derived quantity (pose of a body or site, sensor) after state was "
                "written in the same moment: read it before writing, or from the joint state"
            )
        return self.world

    def forget(self) -> None:
        """Forget computed quantities, whether or not derived ones of the world are current."""
        for cache in self._caches:
            cache.clear()

    def refreshed(self) -> None:
        """Forget computed quantities: the state has changed, and the world has refreshed its derived quantities."""
        self.forget()
        self._is_stale = False

    def changed(self) -> None:
        """Forget computed quantities: the state has changed, and derived quantities have not followed yet."""
        self.forget()
        self._is_stale = True

    def write(
        self,
        state_EL: Float[Tensor, "E L"],
        columns: Index,
        mask_E: Bool[Tensor, " E"],
        value_EN: Float[Tensor, "E N"],
    ) -> None:
        """Copy the rows of `mask_E` into some columns of the state."""
        # Shapes are checked by hand: a wrong one would broadcast in silence.
        width = _width(columns, state_EL.shape[1])
        if (
            value_EN.ndim != 2
            or value_EN.shape[1] not in (1, width)
            or len(value_EN) not in (1, len(state_EL))
        ):
            raise ValueError(
                f"writes values of shape {tuple(value_EN.shape)} into the state: expected ({len(state_EL)}, {width}), "
                "one row per env"
            )
        self.is_writing = True
        try:
            # `where` over all rows, since a captured step cannot index by a mask.
            state_EL[:, columns] = torch.where(mask_E[:, None], value_EN, state_EL[:, columns])
        finally:
            # Also after an error, or later writes would pass unnoticed.
            self.is_writing = False
        self.changed()

    def point_velocity(
        self, point_EN3: Float[Tensor, "E N 3"], body: Index
    ) -> Float[Tensor, "E N 3"]:
        """Return the velocities of points fixed to bodies, world frame, m/s."""
        return self._point_velocity(self.derived(), point_EN3, body)

    def site_velocity_of_contacts(
        self, name: str, site: Index, body: Index, *, count: int
    ) -> Float[Tensor, "E N 3"]:
        """Return the velocities of `count` sites on bodies at the moment that contacts and forces belong to, m/s.

        That is the start of the last substep; rows that were just reset read 0. Ask for it in construction first, by a
        `name` of these sites.
        """
        if name not in self._of_contacts:
            kept_EN3 = self.buffers.get(f"of_contacts/{name}", count, 3, owner=ENV)

            def read() -> Tensor:
                # Not from `derived`: the poses of the last substep are needed here.
                return self._point_velocity(self.world, self.world.site_xpos_EL[:, site], body)

            self._of_contacts[name] = (kept_EN3, read)
        return self._of_contacts[name][0]

    def keep_moment_of_contacts(self) -> None:
        """Keep what terms read of the moment of the contacts; between the last substep and the refresh."""
        for kept, read in self._of_contacts.values():
            # A world that fails in this substep must not leave its numbers to the terms that run after it was cleared.
            kept.copy_(torch.nan_to_num(read(), nan=0.0, posinf=0.0, neginf=0.0))

    def _point_velocity(self, world: World, point_EN3: Tensor, body: Index) -> Tensor:
        # MuJoCo's cvel is (angular, linear) about the centre of mass of the body's kinematic tree.
        # [E, N, 6]: angular first, then linear.
        cvel_EN6 = world.cvel_EL[:, body]
        lever_EN3 = point_EN3 - world.subtree_com_EL[:, self._body_root[body]]
        # Rigid body: v = v_com + omega x lever.
        return cvel_EN6[..., 3:] + torch.linalg.cross(cvel_EN6[..., :3], lever_EN3)

    @contextmanager
    def scope(
        self,
        name: str,
        counter: Int64[Tensor, "*envs"] | None = None,
        *,
        draws: str = "",
        part: object = None,
        mask_E: Bool[Tensor, " E"] | None = None,
    ) -> Iterator[Mapping[str, Kept]]:
        """Run a term under a name, which separates its buffers and draws from others' and stands before its errors.

        `counter` keys the draws (the step count unless given), and `draws` tells apart the moments of one term whose
        counters may coincide. `part` is the running term, if its writes are to be watched, and `mask_E` the rows it may
        write. Gives the tensors that the part has written of its own, by name, where it was watched (see `watch`).
        """
        # Buffers are named by the term, draws by the term and the moment.
        self._scope = name
        self._draw_scope = f"{name}@{draws}"
        # The number of a draw within the term is part of its stream.
        self._draws = 0
        self.reader = name
        if counter is None:
            self._counter = self.step_count
        else:
            self._counter = counter
        try:
            with self.watch(part, mask_E) as written:
                yield written
        except ValueError as error:
            # A term does not know its own place in the config.
            raise ValueError(f"{name.replace('/', '.')}: {error}") from error
        except SystemExit as error:
            # It would end the run as one that has done its work.
            raise RuntimeError(
                f"{name.replace('/', '.')}: it ends the program: {error!r}"
            ) from error
        except Exception as error:
            # Of the same class, which others look for.
            error.add_note(f"(in {name.replace('/', '.')})")
            raise
        # Outside of a term no buffer is read or owned.
        finally:
            self._scope = self.reader = ""

    def watch(
        self, part: object, mask_E: Bool[Tensor, " E"] | None
    ) -> AbstractContextManager[Mapping[str, Kept]]:
        """Watch a part's writes while it runs under `reader`; whoever drives terms may refuse some of it.

        Here nothing is watched.
        """
        return UNWATCHED

    def caches(self) -> list[dict[str, Any]]:
        """Return the caches of computed quantities."""
        return list(self._caches)

    def scoped(self, name: str) -> str:
        """Return the full name of a buffer of the term that runs."""
        return f"{self._scope}.{name}"

    def next_keys(self) -> random.RowKeys:
        """Return the keys of the next draw of the term that runs."""
        # The order of draws within a term counts, not the order of terms.
        stream = random.stream_id(f"{self._draw_scope}#{self._draws}")
        self._draws += 1
        return random.row_keys(self.seed, stream, self._counter, self.num_envs)

    def freeze(self) -> None:
        """End construction: no new buffers."""
        self.is_frozen = self.world.is_frozen = True
        self.buffers.freeze()
        self.shared_values.freeze()


def _width(columns: Index, of_all: int) -> int:
    """Return how many columns an index picks of so many, without picking them."""
    if isinstance(columns, slice):
        # `indices` clips a slice to the columns there are.
        return len(range(*columns.indices(of_all)))
    return columns.numel()
