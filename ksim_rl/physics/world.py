"""The door to the physics: many copies of one model, stepped by MuJoCo Warp or by MuJoCo's C engine."""

import copy
import dataclasses
from abc import abstractmethod
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, Literal, Self, TypeAlias, cast

import mujoco
import torch
from jaxtyping import Bool, Int, Shaped
from torch import Tensor

from ksim_rl.checks import check_count, unknown_name
from ksim_rl.device.state_tree import copy_into
from ksim_rl.device.streams import checked_device
from ksim_rl.physics import views
from ksim_rl.physics.engine_choice import choose_engine
from ksim_rl.physics.field_effects import check_effects, switch_on
from ksim_rl.physics.fields import fields_to_expand
from ksim_rl.physics.model_checks import check_asleep, check_not_simple
from ksim_rl.physics.nan_guard.guard import NanReport
from ksim_rl.physics.overflow import OverflowReport
from ksim_rl.physics.sensors.sensor_checks import check_touched_sites
from ksim_rl.physics.sim_cfg import SimCfg

ENGINES: dict[str, type["World"]] = {}
"""The worlds of each engine, by the names that `SimCfg.engine` knows; their modules enter them here."""


# Objects whose Python a step depends on, each with a reader of its values, by name.
RecordedPython: TypeAlias = Mapping[str, tuple[Any, Callable[[], Mapping[str, Any]]]]


class World(views.DataViews):
    """Worlds of one MuJoCo model that are stepped together; `World(...)` makes a `WarpWorld` or a `CWorld`.

    The two behave alike: `sim.engine` names one, or with "auto" chooses. Arrays of MuJoCo's data are torch tensors with
    a row for each world: the attributes of `DataViews`, such as `qpos_EL` and `ctrl_EL`, and any other by `view(name)`.
    Write `qpos_EL`, `qvel_EL`, `ctrl_EL` and applied forces in place, and call `step`.

    Position- and velocity-stage quantities (poses, velocities, their sensors) belong to the present state after
    `refresh`. Acceleration-stage ones (`qacc`, actuator and contact forces, contact sensors, accelerometers) belong to
    the last substep; rows that reset since then read zero. All views keep their address for the life of the world and
    are changed in place, float32.

    The model fields named in `per_world_fields`, by MuJoCo's names, and gravity may differ between worlds, and with
    them the constants that MuJoCo derives at compile time: call `set_const` after writing.

    Args:
        mj_model: as `load_model` returns it; it is copied.
        num_envs: E, the number of worlds.
        device: "cpu", "cuda" or "cuda:<index>".
        sim: settings that override the model's; None leaves them.
        per_world_fields: names of model fields that may differ between worlds, such as "body_mass".
        warp_alone: features that only MuJoCo Warp has and that will be used, such as cameras, in words; with any,
            engine "auto" is Warp.

    Attributes:
        mj_model: the copy of the model, with the settings of `sim`.
        sim: the settings, with the engine that was chosen; `engine_because` says why.
        is_frozen: whether graphs may hold `refresh`, so that it computes nothing further.
        njmax, nconmax: constraint rows and contacts that a world has room for; 0 where there is no limit.
        gravity_EL: gravity of each world, m/s^2, [E, 3].
        can_be_recorded: whether graphs and recordings may hold steps of the engine.
    """

    engine: ClassVar[Literal["warp", "c"]]
    can_be_recorded: bool = True
    njmax: int = 0
    nconmax: int = 0
    one_kernel_unavailable: str | None = None
    gravity_EL: Tensor

    def __new__(cls, *args: Any, sim: SimCfg | None = None, **kwargs: Any) -> Self:
        """Choose the engine."""
        # `World(...)` chooses a subclass; a call of a subclass makes that one.
        if cls is not World:
            return super().__new__(cls)
        name, _ = _choice(*args, sim=sim, **kwargs)
        return cast("Self", object.__new__(ENGINES[name]))

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
        # Arguments are checked before anything is allocated or compiled.
        check_count("num_envs", num_envs)
        if not isinstance(mj_model, mujoco.MjModel):
            raise ValueError(
                f"mj_model={mj_model!r}: expected a mujoco.MjModel, as load_model returns it"
            )
        if sim is not None and not isinstance(sim, SimCfg):
            raise ValueError(f"sim={sim!r}: expected a SimCfg, or None")
        self.device = checked_device(device)
        # Once more, since a subclass may be called directly.
        name, why = _choice(
            mj_model, num_envs=num_envs, device=device, sim=sim, warp_alone=warp_alone
        )
        if name == self.engine:
            self.engine_because = why
        else:
            self.engine_because = f"a {type(self).__name__} was asked for"
        self.sim = dataclasses.replace(sim or SimCfg(), engine=self.engine)
        self.num_envs = num_envs
        self.is_frozen = False
        # Copied, so that neither settings nor later changes reach the caller's model.
        self.mj_model = copy.copy(mj_model)
        self.sim.apply_to(self.mj_model)
        self._expanded = fields_to_expand(per_world_fields, self.mj_model)
        # Refused before kernels are compiled, which takes up to a minute.
        check_asleep(self.mj_model)
        check_touched_sites(self.mj_model)
        check_not_simple(self.mj_model, self._expanded)
        check_effects(self.mj_model, self._expanded)
        # After the checks, since it changes flags of the model.
        switch_on(self.mj_model, self._expanded)
        self._fields: dict[str, Tensor] = {}

    def _chosen_line(self) -> str:
        """Return the line which says that the engine of this world was chosen, and why."""
        return f"engine {self.engine}: {self.engine_because}"

    @property
    def timestep(self) -> float:
        """Duration of one substep, in s."""
        return float(self.mj_model.opt.timestep)

    @abstractmethod
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
        every one as well; with "every", all on every one. What `refresh` computes is left to it.

        Hooks are called, in order, before each substep (such as a motor model that writes `ctrl`) and after it, when
        `refresh` has not run: `qpos` and `qvel` are of the state reached, poses and sensors as the substep computed
        them on its way.
        """

    @abstractmethod
    def refresh(self, mask_E: Bool[Tensor, " E"] | None = None) -> None:
        """Recompute position- and velocity-stage quantities and sensors from the present `qpos` and `qvel`.

        Acceleration-stage quantities keep the last substep's values. With a mask, rows outside of it must be current
        already.
        """

    @abstractmethod
    def reset(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Put the worlds where `mask_E` is true back to the model's `qpos0`, at rest, time 0.

        Their acceleration-stage quantities and sensors read zero until the next step; the other rows do not change.
        Call `refresh` afterwards, and after writing another pose, before reading poses.
        """

    def field(self, name: str) -> Shaped[Tensor, " E *leaf"]:
        """Return the view of a model field that differs between worlds."""
        if name in self._fields:
            return self._fields[name]
        if name in dir(self.mj_model):
            raise ValueError(
                f"model field {name!r} is shared by all worlds: add it to per_world_fields when the world is built "
                f"(now: {', '.join(sorted(self._fields))})"
            )
        raise unknown_name("per-world model field", name, self._fields)

    def per_world_fields(self) -> dict[str, Shaped[Tensor, " E *?leaf"]]:
        """Return the views of the model fields that differ between worlds, by name."""
        return dict(self._fields)

    @abstractmethod
    def set_const(self, fields: Sequence[str], mask_E: Bool[Tensor, " E"] | None = None) -> None:
        """Recompute the constants that MuJoCo derives from `fields`, after writing into them.

        Fields that nothing derives from cost nothing. Worlds outside of `mask_E` keep their constants bit for bit.
        """

    @abstractmethod
    def launch(self, key: Hashable, launches: Callable[[], None]) -> None:
        """Run Warp launches of the caller's own, such as a camera's, in order with the world's."""

    @abstractmethod
    def record_overflow(self) -> None:
        """Keep the overflow bits and needs of the last substep for the next report, as each substep does by itself."""

    def overflow_report(self, *, clear: bool = True) -> OverflowReport:
        """Read the needs of the physics since the last report; one transfer to the host. Call it once per rollout."""
        return self.explain_overflow(self.overflow_counts(clear=clear).tolist())

    @abstractmethod
    def overflow_counts(self, *, clear: bool = True) -> Int[Tensor, " N"]:
        """Return the numbers that `explain_overflow` explains, on the device, without waiting for it."""

    @abstractmethod
    def explain_overflow(self, numbers: Sequence[int]) -> OverflowReport:
        """Make the report of `overflow_counts` that were read on the host."""

    @property
    @abstractmethod
    def room_is_certain(self) -> bool:
        """Whether `sim` gives the room for contacts and rows, or no state of the model needs more."""

    @abstractmethod
    def remember_needs(self, report: OverflowReport) -> bool:
        """Let later worlds of this model in this process have the room that was needed; whether they get more."""

    @abstractmethod
    def nan_count(self) -> Int[Tensor, ""]:
        """Return how many worlds became non-finite since the last `nan_report`, on the device; 0 without a guard."""

    @abstractmethod
    def nan_report(self) -> NanReport:
        """Write the worlds that became non-finite since the last report to files; one transfer to the host.

        Without `sim.nan_guard` the report is empty.
        """

    @abstractmethod
    def forget_failures(self) -> None:
        """Let the next `nan_report` leave out worlds that became non-finite until now."""

    def state_dict(self) -> dict[str, Shaped[Tensor, "*?leaf"]]:
        """Copy everything that the next steps depend on, so that a restored world continues bit for bit on CPU."""
        return {name: tensor.clone() for name, tensor in self._state_tensors().items()}

    def load_state_dict(self, state_dict: dict[str, Shaped[Tensor, "*?leaf"]]) -> None:
        """Write a saved state of the same model and `num_envs` into the present arrays, then `refresh`."""
        what = "state of a world (of the same model, engine, num_envs and per_world_fields)"
        copy_into(self._state_tensors(), state_dict, what=what)
        self.refresh()

    @abstractmethod
    def bytes_per_world(self) -> int:
        """Return the memory that one more world takes, in bytes (arrays of data and of expanded fields)."""

    @abstractmethod
    def explained(self) -> tuple[str, ...]:
        """Return a line for each stage of a substep, which says what computes it, and why."""

    @abstractmethod
    def recorded_python(self) -> RecordedPython:
        """Return the objects whose Python a recorded step depends on, each with a reader of its values, by name."""

    @abstractmethod
    def memory(self) -> Iterator[tuple[str, Shaped[Tensor, "*?shape"] | None, int, int]]:
        """Yield all arrays: name, view (None where there is none), first byte, and the one behind the last."""

    @abstractmethod
    def close(self) -> None:
        """Free the arrays, after a last `nan_report`. Views that are still held keep their memory."""

    @abstractmethod
    def _state_tensors(self) -> dict[str, Tensor]:
        """Return the tensors that make up the state, by name."""


def _choice(
    mj_model: mujoco.MjModel | None = None,
    *,
    num_envs: int | None = None,
    device: str | torch.device = "cpu",
    sim: SimCfg | None = None,
    warp_alone: Sequence[str] = (),
    **_: Any,
) -> tuple[str, str]:
    """Choose the engine by arguments that are not checked yet; either engine says which of them is wrong."""
    if not isinstance(sim, SimCfg):
        sim = SimCfg()
    if not isinstance(mj_model, mujoco.MjModel) or not isinstance(num_envs, int):
        return "warp", ""
    where = checked_device(device)
    return choose_engine(sim, mj_model, num_envs=num_envs, device=where, warp_alone=warp_alone)
