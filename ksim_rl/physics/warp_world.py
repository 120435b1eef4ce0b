"""A world batch simulates many copies of one model on MuJoCo Warp, and shows their data as zero-copy torch views."""

from collections.abc import Callable, Collection, Hashable, Iterator, Sequence
from typing import Literal, get_args

import mujoco
import mujoco_warp as mjw
import torch
import warp as wp
from jaxtyping import Bool, Int, Shaped
from torch import Tensor

from ksim_rl.checks import check_choice, check_count
from ksim_rl.device.capture import WarpGraphs
from ksim_rl.device.kernel_loading import loaded_together
from ksim_rl.device.memory import memory_for
from ksim_rl.device.streams import warp_scope, warp_stream
from ksim_rl.physics import capacity, upstream, views
from ksim_rl.physics.callbacks import Callbacks
from ksim_rl.physics.constants.masked_constants import MaskedConstants
from ksim_rl.physics.field_effects import as_if_drawn
from ksim_rl.physics.fields import FIXED, GRAVITY, INERT0, const_groups, derived_fields
from ksim_rl.physics.nan_guard.guard import NanGuard, NanReport
from ksim_rl.physics.newton.solver import one_kernel_unavailable, takes_conditional_nodes
from ksim_rl.physics.overflow import OverflowRecord, OverflowReport
from ksim_rl.physics.resets import resets
from ksim_rl.physics.rows.second_limits import room_for_nonzeros
from ksim_rl.physics.sim_cfg import SimCfg
from ksim_rl.physics.substep_plan import SubstepPlan, substep_plan, with_callbacks
from ksim_rl.physics.substeps import Sensors, Substeps
from ksim_rl.physics.warp_model import make_warp_model, stored_form
from ksim_rl.physics.world import ENGINES, RecordedPython, World


class WarpWorld(World):
    """Worlds of one model on MuJoCo Warp, with our kernels where they suit the model; see `World`.

    Views are zero-copy. Everything after construction can be captured in a CUDA graph, except `overflow_report`,
    `state_dict` and `load_state_dict`.

    Attributes:
        njmax, nconmax: constraint rows and contacts that a world has room for.
        one_kernel_unavailable: why MuJoCo Warp's own solver solves the constraints, several times slower on CUDA; None
            where one kernel does (`SimCfg.one_kernel_solver`). That one computes no `qacc_smooth`, which stays zero.
        one_kernel_dynamics_unavailable: why MuJoCo Warp's own kernels compute the smooth dynamics; None where
            one kernel does (`SimCfg.one_kernel_dynamics`).
        one_kernel_rows_unavailable: the same of the constraint rows.
        one_kernel_collisions_unavailable: why MuJoCo Warp's own kernels find contacts, or some of them.
        one_kernel_integration_unavailable: why MuJoCo Warp's own kernels advance the state; None where one kernel does,
            which the same setting asks for. Callbacks that are set later count in `plan`, not in these.
    """

    engine = "warp"

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
        expanded = self._expanded
        self.njmax, self.nconmax = capacity.capacities(self.mj_model, self.sim, expanded)
        capacity.check_countable(self.njmax, self.nconmax, num_envs=num_envs)
        self.one_kernel_unavailable = one_kernel_unavailable(
            self.mj_model, self.sim, njmax=self.njmax
        )
        stored_mj_model = stored_form(self.mj_model, is_sparse=self.has_one_kernel_solver)
        self._graphs = WarpGraphs(self.device, require_graphs=self.sim.require_graphs)
        with memory_for(num_envs, self.device), warp_scope(self.device):
            self.warp_model = make_warp_model(
                self.mj_model, stored_mj_model, self.sim, expanded=expanded, num_envs=num_envs
            )
            if self.device.type == "cuda":
                self.warp_model.opt.graph_conditional = takes_conditional_nodes(
                    self.warp_model, supported=wp.is_conditional_graph_supported()
                )
            nonzeros = room_for_nonzeros(self.warp_model, expanded, njmax=self.njmax)
            self.warp_data_E = mjw.make_data(
                stored_mj_model,
                nworld=num_envs,
                nconmax=self.nconmax,
                njmax=self.njmax,
                njmax_nnz=nonzeros,
            )
            upstream.drop_unread(self.warp_model, self.warp_data_E)
            gravity_EL = upstream.expand_gravity(self.warp_model, num_envs)
            self._overflow = OverflowRecord(self.warp_model, self.warp_data_E)
            self._reset_mask = wp.zeros(num_envs, dtype=bool)
            self._launch_reset = resets(self.warp_model, self.warp_data_E, self._reset_mask)
            m = self.warp_model
            d = self.warp_data_E
            no_solver = self.one_kernel_unavailable
            plan = self._plan = substep_plan(m, d, self.sim, solver_unavailable=no_solver)
            self.one_kernel_dynamics_unavailable = plan.dynamics
            self.one_kernel_rows_unavailable = plan.rows
            self.one_kernel_collisions_unavailable = plan.collisions
            self.one_kernel_integration_unavailable = plan.integration
            # One of torch's, since Warp's own wait for the default stream, which no capture allows.
            side_stream = (
                None if self.device.type == "cpu" else warp_stream(torch.cuda.Stream(self.device))
            )
            with as_if_drawn(m, expanded):
                self._substeps = Substeps(
                    *(self.mj_model, m, d),
                    plan=plan,
                    side_stream=side_stream,
                    mask=self._reset_mask,
                    record=self._overflow.arrays,
                    expanded=expanded,
                )
            self._masked_constants = self._prepare_constants(expanded)
        self._reset_mask_E = wp.to_torch(self._reset_mask)
        self._fields = {name: wp.to_torch(getattr(self.warp_model, name)) for name in expanded}
        self._fields[GRAVITY] = gravity_EL
        self._nan_guard: NanGuard | None = None
        if self.sim.nan_guard is not None:
            state = views.state_tensors(self.warp_data_E)
            with warp_scope(self.device):
                self._nan_guard = NanGuard(
                    self.sim.nan_guard,
                    self.mj_model,
                    state,
                    self._fields,
                    num_envs=num_envs,
                    by_warp=True,
                )
        self.gravity_EL = gravity_EL
        # From here on, callbacks that appear are the program's.
        self._callbacks = Callbacks(self.warp_model)
        self._arrays = views.arrays(self.warp_data_E)
        self.show_views()
        if self.device.type == "cuda":
            self._load_kernels()
        with warp_scope(self.device):
            self._launch_once()
        self._record_resets()

    @property
    def has_one_kernel_solver(self) -> bool:
        """Whether one kernel solves the constraints."""
        return self.one_kernel_unavailable is None

    @property
    def plan(self) -> SubstepPlan:
        """Which kernels compute each stage of the next substep, and why, with the callbacks that are set now."""
        return with_callbacks(self._plan, self._callbacks.of_program())

    def step(
        self,
        n: int = 1,
        *,
        before: Sequence[Callable[[], None]] = (),
        after: Sequence[Callable[[], None]] = (),
        sensors: Literal["last", "contacts", "every"] = "last",
    ) -> None:
        """Advance all worlds by `n` substeps under the present `ctrl`.

        `sensors` says on which substeps sensors are computed: all on the last one; with "contacts", contact sensors on
        every one as well, and no others before the last; with "every", all on every one. What `refresh` computes is
        left to it, and reads zero until then.

        Hooks are called, in order, before each substep (such as a motor model that writes `ctrl`) and after it, when
        `refresh` has not run: `qpos` and `qvel` are of the state reached, poses and sensors as the substep computed
        them on its way. With hooks the substeps are launches of their own, with the hooks' torch work in between;
        without, all of them are one. Inside an outer capture both become part of its graph.
        """
        check_count("n", n)
        check_choice("sensors", sensors, ("last", "contacts", "every"))
        if not before and not after:
            self._run_substeps(("step", n, sensors), lambda: self._launch_substeps(n, sensors))
        else:
            for substep in range(n):
                for hook in before:
                    hook()
                which = self._sensors_of(substep, n, sensors)
                self._run_substeps(
                    ("substep", which), lambda which=which: self._launch_substep(which)
                )
                for hook in after:
                    hook()
        if self._nan_guard is not None:
            self._nan_guard.keep_fields()

    def refresh(self, mask_E: Bool[Tensor, " E"] | None = None) -> None:
        """Recompute position- and velocity-stage quantities and sensors from the present `qpos` and `qvel`.

        Acceleration-stage quantities keep the last substep's values: there is no collision pass. Actuator lengths and
        velocities are recomputed only if a sensor reads them. With a mask, rows outside of it must be current already.
        """
        if mask_E is None:
            self._run_substeps("refresh", self._substeps.refresh)
            return
        self._take_mask(mask_E)
        self._run_substeps("refresh of rows", lambda: self._substeps.refresh(masked=True))

    def view(self, name: str) -> Shaped[Tensor, "*shape"]:
        """Return the view of an array that is current after `refresh`, and let `refresh` compute it from now on.

        Forces of bodies (`cfrc_ext` and the like) belong to the last substep, from the next one on. A RuntimeError
        once the world is frozen, if nothing has read that array before.
        """
        if name in views.ON_DEMAND - self._substeps.refreshed_on_demand:
            if self.is_frozen:
                raise RuntimeError(
                    f"{name} is not computed: let a term of the config read it during construction"
                )
            together = next(names for names in views.ON_DEMAND_TOGETHER if name in names)
            self._substeps.refreshed_on_demand.update(together)
            self._graphs.clear()
            self._record_resets()
        return super().view(name)

    def reset(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Put the worlds where `mask_E` is true back to the model's `qpos0`, at rest, time 0.

        Their acceleration-stage quantities and sensors read zero until the next step; the other rows do not change.
        Call `refresh` afterwards, and after writing another pose, before reading poses.
        """
        self._take_mask(mask_E)
        self._graphs.run("reset", self._launch_reset)

    def set_const(self, fields: Sequence[str], mask_E: Bool[Tensor, " E"] | None = None) -> None:
        """Recompute the constants that MuJoCo derives from `fields`, after writing into them.

        Fields that nothing derives from cost nothing. Worlds outside of `mask_E` keep their constants bit for bit, and
        on most robots cost little: as much as the others only on models with tendons or flexes, with actuators on
        anything but hinges and slides, or with moved frames of bodies that equality constraints tie.
        """
        for name in fields:
            self.field(name)
        groups = const_groups(fields, self.mj_model)
        if not groups:
            return
        constants = self._masked_constants
        if constants is not None and constants.covers(fields):
            self._take_mask(torch.ones_like(self._reset_mask_E) if mask_E is None else mask_E)
            self._graphs.run(("set_const of rows", groups), lambda: constants.launch(groups))
            return
        if mask_E is None:
            self._set_const_everywhere(groups)
            return
        self._take_mask(mask_E)
        held = {name: self._fields[name].clone() for name in derived_fields(groups)}
        self._set_const_everywhere(groups)
        for name, before in held.items():
            rows = mask_E.view(-1, *[1] * (before.ndim - 1))
            self._fields[name].copy_(torch.where(rows, self._fields[name], before))

    def launch(self, key: Hashable, launches: Callable[[], None]) -> None:
        """Run Warp launches of the caller's own, such as a camera's, in order with the world's.

        They are recorded once for each `key` and replayed from then on: their arrays must keep their addresses.
        """
        self._graphs.run(("of others", key), launches)

    def array_names(self) -> Collection[str]:
        """Return the names of the arrays of the Warp data."""
        return self._arrays

    def make_view(self, name: str) -> Shaped[Tensor, "*shape"]:
        """Make the zero-copy view of an array of the Warp data."""
        return wp.to_torch(self._arrays[name])

    def explained(self) -> tuple[str, ...]:
        """Return a line for each stage of a substep, which says what computes it, and why."""
        return (*self.plan.lines(), self._chosen_line())

    def recorded_python(self) -> RecordedPython:
        """Return the callbacks and options of the model, each with a reader of its values, by name."""
        callback = self.warp_model.callback
        opt = self.warp_model.opt
        return {
            "world.warp_model.callback": (callback, lambda: vars(callback)),
            "world.warp_model.opt": (opt, lambda: vars(opt)),
        }

    def memory(self) -> Iterator[tuple[str, Shaped[Tensor, "*?shape"] | None, int, int]]:
        """Yield the arrays of the Warp data and the Warp model."""
        shown = {*views.STATE, *self.views()} & views.READABLE
        for name, array in views.arrays(self.warp_data_E).items():
            if array.size:
                tensor = wp.to_torch(array) if name in shown else None
                yield f"warp_data_E.{name}", tensor, array.ptr, array.ptr + array.capacity
        for name, array in views.arrays(self.warp_model).items():
            if array.size and array.ptr:
                yield f"warp_model.{name}", None, array.ptr, array.ptr + array.capacity

    def record_overflow(self) -> None:
        """Keep the overflow bits and needs of the last substep for the next report, as each substep does by itself."""
        self._graphs.run("record_overflow", self._overflow.record)

    def overflow_counts(self, *, clear: bool = True) -> Int[Tensor, " N"]:
        """Return the numbers that `explain_overflow` explains, on the device, without waiting for it."""
        counts = self._overflow.counts()
        if clear:
            self._overflow.clear()
        return counts

    def explain_overflow(self, numbers: Sequence[int]) -> OverflowReport:
        """Make the report of `overflow_counts` that were read on the host."""
        return self._overflow.explain(numbers)

    @property
    def room_is_certain(self) -> bool:
        """Whether `sim` gives the room for contacts and rows, or no state of the model needs more."""
        return capacity.is_certain(self.mj_model, self.sim, njmax=self.njmax)

    def remember_needs(self, report: OverflowReport) -> bool:
        """Let later worlds of this model in this process have the room that was needed; whether they get more."""
        return capacity.remember(self.mj_model, self.sim, self._expanded, report)

    def nan_count(self) -> Int[Tensor, ""]:
        """Return how many worlds became non-finite since the last `nan_report`, on the device; 0 without a guard."""
        if self._nan_guard is None:
            return torch.zeros((), dtype=torch.int64, device=self.device)
        return self._nan_guard.count()

    def nan_report(self) -> NanReport:
        """Write the worlds that became non-finite since the last report to files; one transfer to the host.

        Without `sim.nan_guard` the report is empty.
        """
        return NanReport() if self._nan_guard is None else self._nan_guard.report()

    def forget_failures(self) -> None:
        """Let the next `nan_report` leave out worlds that became non-finite until now."""
        if self._nan_guard is not None:
            self._nan_guard.forget()

    def bytes_per_world(self) -> int:
        """Return the memory that one more world takes, in bytes (arrays of data and of expanded fields)."""
        fields = sum(tensor.numel() * tensor.element_size() for tensor in self._fields.values())
        return (views.nbytes(self.warp_data_E) + fields) // self.num_envs

    def close(self) -> None:
        """Free the graphs and arrays, after a last `nan_report`. Views that are still held keep their memory."""
        if hasattr(self, "_fields"):
            self.nan_report()
        self._nan_guard = None
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        self._graphs.clear()
        parts = ("_substeps", "_masked_constants", "_overflow", "_launch_reset", "_fields")
        for name in ("warp_data_E", "warp_model", *parts):
            if hasattr(self, name):
                delattr(self, name)
        self._arrays.clear()
        self.drop_views()

    def _load_kernels(self) -> None:
        """Compile and load the kernels of steps, refreshes, resets and `set_const`, before any of them runs."""
        with warp_scope(self.device), loaded_together(self.device):
            self._launch_once()
            for sensors in get_args(Sensors):
                self._launch_substep(sensors)
            self._substeps.refresh()
            self._launch_reset()
            if self._masked_constants is not None:
                self._masked_constants.launch(~FIXED)

    def _launch_once(self) -> None:
        """Launch the kernels that have to run before anything else."""
        mjw.reset_data(self.warp_model, self.warp_data_E)
        if self._masked_constants is not None:
            self._masked_constants.place_frames()

    def _record_resets(self) -> None:
        """Refresh, and record the graphs of `reset` and `refresh`, which warm-ups of outer captures run per env step.

        Launched one by one, resets take longer than the substeps: MuJoCo Warp makes their kernels again each time.
        """
        nowhere_E = torch.zeros_like(self._reset_mask_E)
        for _ in range(2):
            self.reset(nowhere_E)
            self.refresh()
            self.refresh(nowhere_E)

    def _prepare_constants(self, expanded: Sequence[str]) -> MaskedConstants | None:
        groups = const_groups(expanded, self.mj_model)
        if not groups:
            return None
        if groups & FIXED:
            # From now on the same bits, however often they are recomputed.
            upstream.set_fixed_constants(self.warp_model)
        return MaskedConstants(self.mj_model, self.warp_model, self._reset_mask, expanded)

    def _set_const_everywhere(self, groups: int) -> None:
        def launch() -> None:
            # Tendons may lie on them.
            self._substeps.place_fixed_geoms()
            mjw.set_const(self.warp_model, self.warp_data_E, groups)
            if groups & INERT0 and self._masked_constants is not None:
                self._masked_constants.mend_weights()

        self._graphs.run(("set_const", groups), launch)

    def _take_mask(self, mask_E: Tensor) -> None:
        if mask_E.dtype != torch.bool or mask_E.shape != (self.num_envs,):
            raise ValueError(
                f"mask_E is {mask_E.dtype} of shape {tuple(mask_E.shape)}: expected torch.bool of shape "
                f"({self.num_envs},)"
            )
        self._reset_mask_E.copy_(mask_E)

    def _state_tensors(self) -> dict[str, Tensor]:
        tensors = views.state_tensors(self.warp_data_E)
        tensors |= {f"field/{name}": tensor for name, tensor in self._fields.items()}
        overflow = self._overflow.arrays
        return tensors | {
            f"overflow/{name}": wp.to_torch(array) for name, array in overflow.items()
        }

    def _run_substeps(self, key: Hashable, launches: Callable[[], None]) -> None:
        """Run launches of MuJoCo Warp's stages, among which callbacks may stand.

        Callbacks are Python, and set at any time: a graph of before would leave them out, and one with them would never
        run their Python again.
        """
        self._callbacks.keep_ours()
        self._graphs.run(key, launches, live=bool(self._callbacks.of_program()))

    def _launch_substeps(self, n: int, sensors: str) -> None:
        for substep in range(n):
            self._launch_substep(self._sensors_of(substep, n, sensors), is_last=substep == n - 1)

    @staticmethod
    def _sensors_of(substep: int, n: int, sensors: str) -> Sensors:
        amid: dict[str, Sensors] = {"last": "none", "contacts": "contacts", "every": "all"}
        if substep == n - 1 and sensors != "every":
            return "kept"
        return amid[sensors]

    def _launch_substep(self, sensors: Sensors, *, is_last: bool = True) -> None:
        if self._nan_guard is not None:
            self._nan_guard.before_substep()
        self._substeps.advance(sensors=sensors, is_last=is_last)
        if self.one_kernel_integration_unavailable is not None:
            self._overflow.record()
        if self._nan_guard is not None:
            self._nan_guard.after_substep()


ENGINES["warp"] = WarpWorld
