"""Judges one model: worlds of it beside MuJoCo's C engine, from the same states."""

import dataclasses
import re
import textwrap
from collections.abc import Callable, Sequence
from typing import Literal

import mujoco
import numpy as np
import torch

from benchmarks.judge import accepted, c_engine
from benchmarks.judge.comparison import Finding, differences, scales_of
from benchmarks.judge.small_room import untold_overflow
from benchmarks.judge.worlds import Arrays, drawn_state, give_fields, put_all, put_rows, state_of
from ksim_rl.physics import SimCfg, load_model
from ksim_rl.physics.warp_world import WarpWorld

NUM_WORLDS = 4
Kernels = Literal["ours", "our solver", "theirs"]
# Our kernels, MuJoCo Warp's kernels with our solver, and MuJoCo Warp alone, each solved to rounding.
SETTINGS: dict[Kernels, SimCfg] = {
    "ours": SimCfg(
        engine="warp", one_kernel_dynamics=True, tolerance=1e-8, iterations=100, ls_iterations=50
    ),
    "our solver": SimCfg(
        engine="warp", one_kernel_dynamics=False, tolerance=1e-8, iterations=100, ls_iterations=50
    ),
    "theirs": SimCfg(
        engine="warp", one_kernel_solver=False, tolerance=1e-8, iterations=100, ls_iterations=50
    ),
}
# Of what accelerates more, in m/s^2 or rad/s^2, C says nothing that float32 could repeat.
MOST_QACC = 1e5
# Substeps of a call, and the sensors that it computes on the way.
Call = tuple[int, Literal["last", "contacts", "every"]]
CALLS: tuple[Call, ...] = (
    (1, "last"),
    (2, "every"),
    (4, "last"),
    (10, "contacts"),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verdict:
    """What was found about a model.

    Attributes:
        refused: why it could not be built; empty where it ran.
        findings: what differs from C.
        kernels: "ours" where one kernel computed the dynamics, "our solver" or "theirs".
        states: how many states of worlds were compared.
        accepted: how many of them had contacts that may differ, and were judged by their depths.
        unsteady: how many of them C itself did not come through.
        touching: whether any world had a contact.
        reset: whether worlds that were reset were compared with new ones.
        compiled: how many worlds had fields that C compiled from XML.
        short_of_room: whether worlds with less room than they needed were looked at.
        overflow: what the worlds had no room for, and said so.
    """

    refused: str = ""
    findings: tuple[Finding, ...] = ()
    kernels: str = ""
    states: int = 0
    accepted: int = 0
    unsteady: int = 0
    touching: bool = False
    reset: bool = False
    compiled: int = 0
    short_of_room: bool = False
    overflow: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Given:
    """What worlds are given.

    Args:
        fields: in which they differ.
        models: C's model of each world.
        states: in which they start.
        compiled: how many of the models C compiled from XML that has the fields.
    """

    fields: tuple[str, ...] = ()
    models: list[mujoco.MjModel]
    states: list[Arrays]
    compiled: int = 0


def judge(
    xml: str,
    *,
    fields: Sequence[str] = (),
    kernels: Kernels = "ours",
    forces: bool = True,
    seed: int = 0,
    device: str = "cpu",
    calls: Sequence[Call] = CALLS,
) -> Verdict:
    """Run both engines and compare all that a view can name."""
    sim = SETTINGS[kernels]
    try:
        mj_model = load_model(xml, sim)
        world = WarpWorld(
            mj_model, num_envs=NUM_WORLDS, device=device, sim=sim, per_world_fields=tuple(fields)
        )
    except ValueError as error:
        return Verdict(refused=reason(str(error)))
    rng = np.random.default_rng(seed)
    models, compiled = give_fields(world, tuple(fields), rng, xml, sim)
    states = [drawn_state(each, rng, forces=forces) for each in models]
    given = Given(fields=tuple(fields), models=models, states=states, compiled=compiled)
    return judge_worlds(world, given, seed=seed, calls=calls)


def judge_worlds(
    world: WarpWorld, given: Given, *, seed: int, calls: Sequence[Call] = CALLS
) -> Verdict:
    """Compare worlds that have their fields with C's models of them, and close them."""
    trial = _Trial(world, given, seed=seed)
    for substeps, sensors in calls:
        trial.compare(substeps, sensors)
    trial.compare(2, "last", hook=_nothing)
    if trial.verdict.findings == () and not trial.verdict.overflow:
        if repeats_bits(world):
            trial.compare_reset()
        trial.compare_small_room()
    world.close()
    return trial.verdict


def repeats_bits(world: WarpWorld) -> bool:
    """Whether the same state leads to the same bits: on GPUs where all kernels are ours, which add in one order."""
    unavailable = (world.one_kernel_dynamics_unavailable, world.one_kernel_rows_unavailable)
    return world.device.type == "cpu" or unavailable == (None, None)


def reason(message: str) -> str:
    """Return a refusal without the names and numbers of the model."""
    plain = re.sub(
        r"'[^']*'|\bnumber \d+ \(unnamed\)|[-\d.]+(?:e-?\d+)?",
        "",
        message.replace("XML string: ", ""),
    )
    return textwrap.shorten(plain, 120, placeholder=" ...")


def _nothing() -> None:
    """A hook of substeps, which makes them launches of their own."""


class _Trial:
    """The worlds of a model, C's models of them, and the states that they are in."""

    def __init__(self, world: WarpWorld, given: Given, *, seed: int) -> None:
        self.world = world
        self.fields = given.fields
        self.models = given.models
        self.states = given.states
        self.seed = seed
        names = (*c_engine.REACHED, *c_engine.LAST, *c_engine.OF_BODIES, *c_engine.REFRESHED)
        self.views = {name: world.view(name) for name in names}
        kernels = "ours" if world.one_kernel_dynamics_unavailable is None else "our solver"
        if world.one_kernel_unavailable is not None:
            kernels = "theirs"
        self.verdict = Verdict(kernels=kernels, compiled=given.compiled)
        self._check_constants()

    def _add(self, **changes: object) -> None:
        self.verdict = dataclasses.replace(self.verdict, **changes)

    def _find(self, quantity: str, error: float, limit: float, world: int, when: str) -> None:
        finding = Finding(quantity=quantity, error=error, limit=limit, world=world, when=when)
        self._add(findings=(*self.verdict.findings, finding))

    def _check_constants(self) -> None:
        """Compare what follows from the worlds' fields with what C derives from them."""
        fields = self.world.per_world_fields()
        for name, field in fields.items():
            if name in self.fields or name == "gravity":
                continue
            for row, mj_model in enumerate(self.models):
                wanted = np.asarray(getattr(mj_model, name), dtype=np.float64)
                found = field[row].numpy(force=True).reshape(-1)
                if found.size != wanted.size:
                    continue
                error = float(np.abs(found - wanted.reshape(-1)).max(initial=0.0))
                limit = 1e-3 * max(1e-3, float(np.abs(wanted).max(initial=0.0)))
                if not error <= limit:
                    self._find(f"constant {name}", error, limit, row, "set_const")

    def compare(
        self,
        substeps: int,
        sensors: Literal["last", "contacts", "every"],
        *,
        hook: Callable[[], None] | None = None,
    ) -> None:
        """Step both engines from the present states, compare, and go on from the states that C reaches."""
        world = self.world
        when = f"step({substeps}, sensors={sensors!r}{', after=...' if hook else ''})"
        put_all(world, self.states)
        world.step(substeps, sensors=sensors, after=() if hook is None else (hook,))
        report = world.overflow_report()
        if not report.ok:
            self._add(overflow=tuple(report.messages))
        found = {name: rows(view) for name, view in self.views.items()}
        sensed = rows(world.sensordata_EL)
        contacts = _contacts(world)
        world.refresh()
        found |= {name: rows(self.views[name]) for name in c_engine.REFRESHED}
        sensed_later = rows(world.sensordata_EL)
        expected = [
            c_engine.run(mj_model, state, substeps)
            for mj_model, state in zip(self.models, self.states, strict=True)
        ]
        scales = scales_of([quantities for quantities, _ in expected])
        for row, (quantities, mj_data) in enumerate(expected):
            mj_model, state = self.models[row], self.states[row]
            self._add(
                states=self.verdict.states + 1, touching=self.verdict.touching or mj_data.ncon > 0
            )
            if (
                any(warning.number for warning in mj_data.warning)
                or not np.abs(mj_data.qacc).max(initial=0.0) < MOST_QACC
            ):
                self._add(unsteady=self.verdict.unsteady + 1)
                continue
            if report.ok and not self._has_accepted(row, mj_data, contacts[row], when):
                actual = {name: value[row] for name, value in found.items()}
                actual |= _sensors(
                    mj_model, sensed[row], sensed_later[row], all_of_them=sensors == "every"
                )
                differing = differences(
                    *(mj_model, state, substeps, actual, quantities),
                    scales=scales,
                    seed=self.seed,
                    world=row,
                    when=when,
                )
                # Such contacts decide what follows, too, when they have gone.
                if differing and c_engine.touched_accepted(mj_model, state, substeps):
                    self._add(accepted=self.verdict.accepted + 1)
                else:
                    self._add(findings=(*self.verdict.findings, *differing))
            self.states[row] = state_of(mj_data)

    def _has_accepted(
        self, row: int, mj_data: mujoco.MjData, found: tuple[np.ndarray, np.ndarray], when: str
    ) -> bool:
        """Whether contacts that may differ decide a world; their depths are compared."""
        mj_model = mj_data.model
        wanted = accepted.depths_in_c(mj_data)
        actual = accepted.depths(mj_model, *found)
        if not wanted and not actual:
            return False
        self._add(accepted=self.verdict.accepted + 1)
        # After one substep alone the two are of the same state.
        if not when.startswith("step(1,"):
            return True
        for pair in wanted.keys() & actual.keys():
            error = abs(wanted[pair] - actual[pair])
            limit = accepted.depth_limit(mj_model, pair, wanted[pair], actual[pair])
            if limit is not None and not error <= limit:
                kinds = " ".join(
                    accepted.name_of(kind) for kind in accepted.kinds_of(mj_model, pair)
                )
                self._find(f"depth {kinds}", error, limit, row, when)
        return True

    def compare_reset(self) -> None:
        """Compare worlds that were reset, beside others that were not, with new ones; the bits must be equal."""
        world = self.world
        self._add(reset=True)
        fresh = WarpWorld(
            world.mj_model,
            num_envs=world.num_envs,
            device=world.device,
            sim=world.sim,
            per_world_fields=self.fields,
        )
        for name, field in fresh.per_world_fields().items():
            field.copy_(world.per_world_fields()[name])
        put_all(fresh, self.states)
        some = torch.arange(world.num_envs, device=world.device) % 2 == 0
        put_all(world, self.states)
        world.step(3)
        world.reset(some)
        put_rows(world, self.states, [row for row in range(world.num_envs) if some[row]])
        for each in (fresh, world):
            each.step(2, sensors="every")
            each.refresh()
        for name in (*c_engine.REACHED, "qacc", "xpos", "sensordata"):
            same, new = world.view(name)[some], fresh.view(name)[some]
            if same.numel() and not torch.equal(same.nan_to_num(), new.nan_to_num()):
                error = float((same.double() - new.double()).abs().max())
                self._find(f"reset {name}", error, 0.0, 0, "reset(mask)")
        fresh.close()

    def compare_small_room(self) -> None:
        """Look whether worlds that have too little room say so."""
        found = untold_overflow(self.world, self.states)
        if found is not None:
            self._add(short_of_room=True, findings=(*self.verdict.findings, *found))


def rows(view: torch.Tensor) -> np.ndarray:
    """Return a copy of a view, a row for each world, in float64."""
    return view.numpy(force=True).astype(np.float64).reshape(view.shape[0], -1)


def _sensors(
    mj_model: mujoco.MjModel, last: np.ndarray, later: np.ndarray, *, all_of_them: bool
) -> Arrays:
    """Return what sensors read after the last substep, those that wait for a refresh left out, and after that."""
    found = {}
    for sensor in range(mj_model.nsensor):
        columns, name = c_engine.columns_of(mj_model, sensor), c_engine.name_of(mj_model, sensor)
        # Adhesion pulls at contacts, and a refresh finds no new ones.
        if not _is_of_adhesion(mj_model, sensor):
            found[f"sensor {name} later"] = later[columns]
        if all_of_them or c_engine.is_kept(mj_model, sensor):
            found[f"sensor {name}"] = last[columns]
    return found


def _is_of_adhesion(mj_model: mujoco.MjModel, sensor: int) -> bool:
    if mj_model.sensor_objtype[sensor] != mujoco.mjtObj.mjOBJ_ACTUATOR:
        return False
    kind = mj_model.actuator_trntype[mj_model.sensor_objid[sensor]]
    return kind == mujoco.mjtTrn.mjTRN_BODY


def _contacts(world: WarpWorld) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the parts [N, 2] and distances [N] of each world's contacts."""
    count = int(world.last_substep("nacon").item())
    owners = world.last_substep("contact.worldid")[:count].numpy(force=True)
    dist = world.last_substep("contact.dist")[:count].numpy(force=True)
    # Models without flexes have no arrays of them.
    names = ["geom", "flex", "elem"] if world.mj_model.nflex else ["geom", "geom", "geom"]
    numbers = (world.last_substep(f"contact.{name}")[:count].numpy(force=True) for name in names)
    parts = accepted.parts_of(world.mj_model, *numbers)
    return [(parts[owners == row], dist[owners == row]) for row in range(world.num_envs)]
