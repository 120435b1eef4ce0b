"""Worlds on MuJoCo's C engine: `mujoco.batch` steps many simulations on all cores, in float64."""

import copy
from collections.abc import Callable, Collection, Hashable, Iterator, Sequence
from contextlib import contextmanager
from typing import Literal

import mujoco
import mujoco.batch
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from ksim_rl.checks import check_choice, check_count
from ksim_rl.physics import views
from ksim_rl.physics.c_engine import geom_bounds
from ksim_rl.physics.c_engine.by_world import ByWorld, left_out
from ksim_rl.physics.c_engine.mirrors import Mirror, bound
from ksim_rl.physics.fields import FIXED, GRAVITY, const_groups, derived_fields
from ksim_rl.physics.load import caught_warnings
from ksim_rl.physics.nan_guard.guard import NanGuard, NanReport
from ksim_rl.physics.overflow import BIT_NAMES, OverflowReport
from ksim_rl.physics.sim_cfg import SimCfg
from ksim_rl.physics.world import ENGINES, RecordedPython, World

_STAGE_NONE = int(mujoco.mjtStage.mjSTAGE_NONE)
_STAGE_VEL = int(mujoco.mjtStage.mjSTAGE_VEL)
_STAGE_ACC = int(mujoco.mjtStage.mjSTAGE_ACC)
# The arrays that a step reads of its worlds, and writes back.
_STATE = (*views.SUBSTEP_INPUTS, "eq_active", "userdata", "history", "plastic", "plugin_state")
# Arrays that MuJoCo Warp alone has, or that C calls by another name.
_NOT_OF_C = frozenset(("nbody_awake", "ntree_awake", "nv_awake", "overflow"))
# Fields that move or resize geoms within their bodies, whose trees of bounds MuJoCo's compiler makes once.
_MOVES_GEOMS = frozenset(("geom_size", "geom_pos", "geom_quat"))


class CWorld(World):
    """Worlds of one model on MuJoCo's C engine; see `World`.

    The state is rounded to float32 once per `step(n)`, and never within, so that views have all of it. From equal
    float32 states `step` reaches, bit for bit, the float32 of the states that `mujoco.mj_step` reaches, whatever the
    number of threads. Contacts and constraint rows have no limit but the model's memory; a RuntimeError says where that
    is full.
    """

    engine = "c"
    can_be_recorded = False

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        *,
        num_envs: int,
        device: str | torch.device = "cpu",
        sim: SimCfg | None = None,
        per_world_fields: Sequence[str] = (),
        warp_alone: Sequence[str] = (),
    ) -> None:
        given = {"num_envs": num_envs, "device": device, "sim": sim, "warp_alone": warp_alone}
        super().__init__(mj_model, per_world_fields=per_world_fields, **given)
        _check_suits(self.sim, self.device)
        stepped = copy.copy(self.mj_model)
        # A state that is not finite stays so, and its env ends by it.
        stepped.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        if _MOVES_GEOMS & set(self._expanded):
            stepped.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
        # One MjData for each world: quantities that a call leaves out keep that world's last values.
        self._batch = mujoco.batch.Batch(stepped, num_envs, persistent=True)
        self._data_bytes = mujoco.MjData(stepped).nbuffer
        # Views of the fields are float32 mirrors of the engine's float64 arrays.
        self._of_fields = {name: Mirror(name, self._batch.expand(name)) for name in self._expanded}
        self._of_fields[GRAVITY] = Mirror(GRAVITY, self._batch.expand("opt.gravity"))
        self._fields = {name: mirror.tensor for name, mirror in self._of_fields.items()}
        self.gravity_EL = self._fields[GRAVITY]
        with _told():
            self._batch.reset(stage=_STAGE_NONE)
        self._of_state = bound(self._batch, _STATE)
        # `make_view` adds the arrays that are read, so that others are never copied.
        self._of_data = dict(self._of_state)
        self._left_out = left_out(stepped)
        self._by_world = ByWorld(self._batch)
        self._nan_guard: NanGuard | None = None
        if self.sim.nan_guard is not None:
            tensors = {name: mirror.tensor for name, mirror in self._of_state.items()}
            self._nan_guard = NanGuard(
                self.sim.nan_guard,
                self.mj_model,
                tensors,
                self._fields,
                num_envs=num_envs,
                by_warp=False,
            )
        # Views exist before the first refresh, which fills them.
        self.show_views()
        self.refresh()

    def step(
        self,
        n: int = 1,
        *,
        before: Sequence[Callable[[], None]] = (),
        after: Sequence[Callable[[], None]] = (),
        sensors: Literal["last", "contacts", "every"] = "last",
    ) -> None:
        """Advance all worlds by `n` substeps under the present `ctrl`; see `World.step`.

        Each substep computes all sensors, whichever are asked for.
        """
        # Arguments are checked before anything is written into the engine.
        check_count("n", n)
        check_choice("sensors", sensors, ("last", "contacts", "every"))
        self._push_all()
        # Hooks and the guard must see each substep's state; without them, one call advances by all `n`.
        if before or after or self._nan_guard is not None:
            for substep in range(n):
                is_read = sensors == "every" or substep == n - 1
                self._step_between(before, after, is_read=is_read)
        else:
            self._advance(n, is_read=True)
        if self._nan_guard is not None:
            self._nan_guard.keep_fields()

    def _step_between(
        self,
        before: Sequence[Callable[[], None]],
        after: Sequence[Callable[[], None]],
        *,
        is_read: bool,
    ) -> None:
        """Advance by one substep between hooks, whose changes alone are float32."""
        # Hooks may write ctrl or applied forces.
        for hook in before:
            hook()
        if self._nan_guard is not None:
            self._nan_guard.before_substep()
        # An unchanged state stays float64 in the engine.
        self._push_changes()
        self._advance(1, is_read=is_read)
        if self._nan_guard is not None:
            self._nan_guard.after_substep()
        for hook in after:
            hook()
        self._push_changes()

    def _advance(self, n: int, *, is_read: bool) -> None:
        """Advance by `n` substeps, with the forces of bodies on the last one where anything reads them."""
        if is_read and self._by_world.has(views.FORCES_OF_BODIES):
            if n > 1:
                self._run(lambda: self._batch.step(nstep=n - 1, stage=_STAGE_NONE))
            # Integrators leave other velocities, and "rk4" other stages, than those that the forces belong to. The step
            # continues from here, to the same bits.
            self._run(lambda: self._batch.forward(stage=_STAGE_ACC))
            self._by_world.fill(views.FORCES_OF_BODIES, range(self.num_envs))
            n = 1
        self._run(lambda: self._batch.step(nstep=n, stage=_STAGE_NONE))
        self._pull()

    def refresh(self, mask_E: Bool[Tensor, " E"] | None = None) -> None:
        """Recompute position- and velocity-stage quantities and sensors from the present state; see `World.refresh`."""
        # None stands for all worlds, as in the engine's own calls.
        if mask_E is None:
            rows = None
        else:
            rows = self._rows(mask_E)
        if rows is not None and rows.numel() == 0:
            return
        self._push_all()
        # C recomputes accelerations and forces on its way, but they belong to the last substep.
        kept = {name: self._of_data[name].tensor.clone() for name in self._kept_by_refresh()}
        self._compute_velocities(rows)
        for mirror in self._of_data.values():
            mirror.pull(rows)
        for name, tensor in kept.items():
            self._of_data[name].tensor.copy_(tensor)

    def _compute_velocities(self, rows: Tensor | None = None) -> None:
        """Compute the stages of positions and velocities, in all worlds or in some."""
        ids = None if rows is None else rows.numpy()
        self._run(lambda: self._batch.forward(ids=ids, stage=_STAGE_VEL))
        # Velocities of subtrees are computed in C for sensors only.
        self._by_world.fill(views.SUBTREE_VELOCITIES, range(self.num_envs) if ids is None else ids)

    def _kept_by_refresh(self) -> list[str]:
        """Return the names of arrays of the last substep, which C computes on its way to the velocities, too."""
        return [name for name in views.ACCELERATION_STAGE if name in self._of_data]

    def reset(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Put the worlds where `mask_E` is true back to the model's `qpos0`, at rest, time 0; see `World.reset`."""
        rows = self._rows(mask_E)
        if rows.numel() == 0:
            return
        # A qpos0 that was written for some worlds must reach the engine before it resets them to it.
        self._push_changes()
        self._run(lambda: self._batch.reset(ids=rows.numpy(), stage=_STAGE_NONE))
        # State comes from the engine; accelerations and sensors read zero until the next step.
        for name, mirror in self._of_data.items():
            if name in self._of_state:
                mirror.pull(rows)
            elif name in views.STATE:
                mirror.tensor[rows] = 0

    def set_const(self, fields: Sequence[str], mask_E: Bool[Tensor, " E"] | None = None) -> None:
        """Recompute the constants that MuJoCo derives from `fields`, after writing into them; see `World.set_const`."""
        for name in fields:
            self.field(name)
        groups = const_groups(fields, self.mj_model)
        if not groups:
            return
        # Masks become row numbers, which the engine takes.
        rows = self._rows(torch.ones(self.num_envs, dtype=torch.bool) if mask_E is None else mask_E)
        if rows.numel() == 0:
            return
        self._push_all()
        self._run(lambda: self._batch.set_const(ids=rows.numpy()))
        # The engine writes derived constants into its own arrays; the mirrors have to follow.
        for name in derived_fields(groups):
            self._of_fields[name].pull(rows)
        if groups & FIXED and "geom_size" in self._fields:
            self._bound_geoms(rows)

    def _bound_geoms(self, rows: Tensor) -> None:
        # New sizes of the chosen worlds, float64 [rows, N, 3].
        size_EN3 = self._batch.expand("geom_size")[rows.numpy()]
        half_EN3, has_size = geom_bounds.half_sizes(self.mj_model, size_EN3)
        # Geoms whose bounds do not follow from their size (meshes, say) keep the compiled ones.
        chosen = np.ix_(rows.numpy(), has_size)
        self._batch.expand("geom_rbound")[chosen] = geom_bounds.radii(self.mj_model, size_EN3)[
            :, has_size
        ]
        boxes = self._batch.expand("geom_aabb")
        # The second half of a box is its half sizes; the first, its centre, does not depend on the size.
        boxes[rows.numpy()[:, None], np.flatnonzero(has_size), 3:] = half_EN3[:, has_size]
        for name in ("geom_rbound", "geom_aabb"):
            self._of_fields[name].pull(rows)

    def cast_rays(
        self,
        start_EN3: Float[Tensor, "E N 3"],
        direction_EN3: Float[Tensor, "E N 3"],
        groups: Sequence[bool],
        exclude_body: int,
    ) -> tuple[Float[Tensor, "E N"], Float[Tensor, "E N 3"]]:
        """Return distances [E, N] m, -1 for none, and normals [E, N, 3], of the first geoms that rays hit."""
        # Rays are cast in poses of the present fields and state.
        self._push_all()
        distance, _, normal = self._batch.ray(
            start_EN3.double().numpy(),
            direction_EN3.double().numpy(),
            geomgroup=np.array(groups, dtype=np.uint8),
            bodyexclude=exclude_body,
            normal=True,
        )
        return torch.from_numpy(distance).float(), torch.from_numpy(normal).float()

    def launch(self, key: Hashable, launches: Callable[[], None]) -> None:
        """Refuse Warp launches: there are no Warp arrays here."""
        raise ValueError(
            "sim.engine='c' has no Warp arrays to launch kernels on: choose sim.engine='warp'"
        )

    def record_overflow(self) -> None:
        """Do nothing: a step whose memory is full raises."""

    def overflow_counts(self, *, clear: bool = True) -> Int[Tensor, " N"]:
        """Return zeros: nothing overflows without an error."""
        # The layout of the Warp engine: a count for each bit, then three needs.
        return torch.zeros(len(BIT_NAMES) + 3, dtype=torch.int64)

    def explain_overflow(self, numbers: Sequence[int]) -> OverflowReport:
        """Return a report without losses."""
        worlds = dict.fromkeys(BIT_NAMES, 0)
        return OverflowReport(
            worlds=worlds, nefc=0, njmax=0, ncon=0, naconmax=0, num_envs=self.num_envs
        )

    @property
    def room_is_certain(self) -> bool:
        """True: contacts and rows have no limit but the model's memory."""
        return True

    def remember_needs(self, report: OverflowReport) -> bool:
        """Return False: later worlds get no more."""
        return False

    def nan_count(self) -> Int[Tensor, ""]:
        """Return how many worlds became non-finite since the last `nan_report`; 0 without a guard."""
        if self._nan_guard is None:
            return torch.zeros((), dtype=torch.int64)
        return self._nan_guard.count()

    def nan_report(self) -> NanReport:
        """Write the worlds that became non-finite since the last report to files; see `World.nan_report`."""
        if self._nan_guard is None:
            return NanReport()
        return self._nan_guard.report()

    def forget_failures(self) -> None:
        """Let the next `nan_report` leave out worlds that became non-finite until now."""
        if self._nan_guard is not None:
            self._nan_guard.forget()

    def bytes_per_world(self) -> int:
        """Return the bytes of one MjData and of the views of a world, without the memory of contacts and rows."""
        tensors = [mirror.tensor for mirror in (*self._of_data.values(), *self._of_fields.values())]
        shown = sum(tensor.numel() * tensor.element_size() for tensor in tensors) // self.num_envs
        return self._data_bytes + shown

    def explained(self) -> tuple[str, ...]:
        """Return that the C engine computes every stage, and why it was chosen."""
        threads = self._batch.nthread
        return (
            f"every stage is computed by MuJoCo's C engine, in float64, on {threads} threads",
            self._chosen_line(),
        )

    def recorded_python(self) -> RecordedPython:
        """Return nothing: a step depends on no Python of the engine."""
        return {}

    def memory(self) -> Iterator[tuple[str, Shaped[Tensor, "*?shape"] | None, int, int]]:
        """Yield the views of the data."""
        for name, mirror in self._of_data.items():
            start = mirror.tensor.data_ptr()
            yield (
                f"data.{name}",
                mirror.tensor,
                start,
                start + mirror.tensor.numel() * mirror.tensor.element_size(),
            )

    def array_names(self) -> Collection[str]:
        """Return the names of the arrays of MjData that every world has."""
        return views.READABLE - _NOT_OF_C

    def make_view(self, name: str) -> Shaped[Tensor, "*shape"]:
        """Make the view of an array; quantities that C computes only for sensors cost extra without them."""
        if name not in self._of_data:
            # A graph or a recorded program that holds `refresh` would not fill a new view.
            if self.is_frozen:
                raise RuntimeError(
                    f"{name} is not computed: let a term of the config read it during construction"
                )
            self._of_data[name] = Mirror(name, self._array(name))
            # Arrays are filled by the next call.
            self._compute_velocities()
            self._of_data[name].pull()
        return self._of_data[name].tensor

    def _array(self, name: str) -> np.ndarray:
        # Arrays that no sensor makes C compute are computed by us, one world after the other.
        if name in self._left_out:
            return self._by_world.array(name)
        return self._batch.bind(name)

    def close(self) -> None:
        """Free the simulations, after a last `nan_report`. Views that are still held keep their memory."""
        if self._nan_guard is not None:
            self.nan_report()
        # The guard's arrays are freed with it, so the last report is written first.
        self._nan_guard = None
        self.drop_views()

    def _state_tensors(self) -> dict[str, Tensor]:
        found = {name: mirror.tensor for name, mirror in self._of_state.items()}
        # STATE lists arrays of both engines; only those with a view can be saved.
        for name in views.STATE:
            if name in self._of_data:
                found[name] = self._of_data[name].tensor
        return found | {f"field/{name}": tensor for name, tensor in self._fields.items()}

    def _push_all(self) -> None:
        """Write state and fields into the engine: from here on all of them are float32."""
        # The whole state is rounded, changed or not, so that a step depends on nothing that the views do not show.
        for mirror in self._of_state.values():
            mirror.push()
        # Fields are float32 already; most of them change only at resets.
        for mirror in self._of_fields.values():
            mirror.push_changes()

    def _push_changes(self) -> None:
        for mirror in (*self._of_state.values(), *self._of_fields.values()):
            mirror.push_changes()

    def _pull(self) -> None:
        for mirror in self._of_data.values():
            mirror.pull()

    def _run(self, call: Callable[[], None]) -> None:
        """Run a call of the engine; a RuntimeError names the worlds in which it failed, or ran out of memory."""
        # The engine fails in two ways: by this exception, or by a warning that `_told` makes a RuntimeError.
        try:
            with _told():
                call()
        except mujoco.batch.SimulationError as error:
            raise RuntimeError(f"MuJoCo's C engine failed: {error}") from error

    def _rows(self, mask_E: Tensor) -> Tensor:
        if mask_E.dtype != torch.bool or mask_E.shape != (self.num_envs,):
            raise ValueError(
                f"mask_E is {mask_E.dtype} of shape {tuple(mask_E.shape)}: expected torch.bool of shape "
                f"({self.num_envs},)"
            )
        return mask_E.nonzero().flatten()


def _check_suits(sim: SimCfg, device: torch.device) -> None:
    """Refuse settings that the C engine cannot follow."""
    if device.type != "cpu":
        raise ValueError(
            f"sim.engine='c' runs on the CPU, and device is {device}: choose device='cpu' or engine='warp'"
        )
    if sim.one_kernel_dynamics:
        raise ValueError(
            "sim.one_kernel_dynamics=True asks for kernels of ours, and sim.engine='c' has none: leave one of them out"
        )


@contextmanager
def _told() -> Iterator[None]:
    """Keep MuJoCo's warnings from the terminal; a RuntimeError where its memory was too small.

    Of a state that is not finite the env tells.
    """
    with caught_warnings() as caught:
        yield
    for text in caught:
        if "memory" in text or "arena" in text or "full" in text:
            raise RuntimeError(
                f"{text.splitlines()[0]} (MuJoCo's C engine; in XML: <size memory='...'/>)"
            )


ENGINES["c"] = CWorld
