"""The faults of physics that were mended, and how each is put back; the issue about truth numbered them."""

import importlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from benchmarks.judge.trial import Kernels
from ksim_rl.device import headers

PHYSICS = "ksim_rl.physics"


@dataclass(frozen=True, kw_only=True)
class Fault:
    """A fault, and how it is put back.

    Args:
        number: of the fault in the issue; empty where another one was found later.
        what: it does.
        place: the module under `physics` and the name there of what mends it, behind the class or module it is of.
        instead: makes what stands there while it is put back, from what mends it.
        needs: the features that a model needs for it, all of them.
        written: a pattern that the model's XML has.
        suits: whether a compiled model may show it.
        kernels: by which it shows.
    """

    number: str = ""
    what: str
    place: tuple[str, str]
    instead: Callable[[Any], Any]
    needs: tuple[str, ...]
    written: str = ""
    suits: Callable[[mujoco.MjModel], bool] | None = None
    kernels: Kernels = "our solver"


@dataclass(frozen=True, kw_only=True)
class Rewrite:
    """Lines of C++ as they were.

    Args:
        lines: what stood in the headers of kernels before, by what stands there.
    """

    lines: Mapping[str, str]

    def __call__(self, text_of: Callable[..., str]) -> Callable[..., str]:
        """Return what gives the texts of headers with the lines as they were."""

        def changed(header: str, constants: Mapping[str, headers.Constant] | None = None) -> str:
            text = text_of(header, constants)
            for new, old in self.lines.items():
                text = text.replace(new, old)
            return text

        return changed


def gives(value: Any) -> Callable[[Any], Any]:
    """Return what puts a value in the place of what mends a fault."""

    def make(mends: Any) -> Any:
        return value

    return make


def nothing(*given: Any, **named: Any) -> None:
    """Do nothing, and give nothing."""


def no(*given: Any, **named: Any) -> bool:
    """Say no."""
    return False


def yes(*given: Any, **named: Any) -> bool:
    """Say yes."""
    return True


def none_of_them(*given: Any, **named: Any) -> list[int]:
    """Give an empty list."""
    return []


def the_first(given: Any, *others: Any) -> Any:
    """Give what was given."""
    return given


def several_short_chains(limbs: Any, *, nv: int) -> bool:
    """Say whether a tree has a short trunk and limbs, though padding makes its rows no narrower."""
    return len(limbs.chains) > 1 and len(limbs.trunk) <= 10 and len(limbs.chains[-1]) <= 8


def is_small_and_branches(mj_model: mujoco.MjModel) -> bool:
    """Say whether a model has few degrees of freedom, two of which hang from a third."""
    parents = mj_model.dof_parentid[mj_model.dof_parentid >= 0]
    return mj_model.nv <= 5 and np.unique(parents).size < parents.size


def touching(mj_model: mujoco.MjModel) -> list[set[int]]:
    """Return the geoms of each contact soon after a model begins to fall; none of trees that may sleep."""
    # MuJoCo ends programs in which trees that may sleep are tied.
    if mj_model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
        return []
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_step(mj_model, mj_data, 30)
    return [{int(geom) for geom in pair} for pair in mj_data.contact.geom]


def touches_twice(mj_model: mujoco.MjModel) -> bool:
    """Say whether two pairs of the same geoms make contacts."""
    signatures = mj_model.pair_signature
    if signatures.size == np.unique(signatures).size:
        return False
    return {int(mj_model.pair_geom1[0]), int(mj_model.pair_geom2[0])} in touching(mj_model)


def of_one_body(mj_model: mujoco.MjModel) -> bool:
    """Say whether a pair is of two geoms of one rigid body, which touch."""
    first, second = mj_model.pair_geom1, mj_model.pair_geom2
    owners = mj_model.body_weldid[mj_model.geom_bodyid]
    contacts = touching(mj_model)
    rigid = np.flatnonzero(owners[first] == owners[second])
    return any({int(first[pair]), int(second[pair])} in contacts for pair in rigid)


def several_in_a_sensor(mj_model: mujoco.MjModel) -> bool:
    """Say whether a contact sensor that lists contacts one by one comes to read two of them."""
    mj_data = mujoco.MjData(mj_model)
    listing = (mj_model.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT) & (
        mj_model.sensor_intprm[:, 1] == 0
    )
    for _ in range(150):
        mujoco.mj_step(mj_model, mj_data)
        for sensor in np.flatnonzero(listing):
            start = mj_model.sensor_adr[sensor]
            slots = mj_model.sensor_intprm[sensor, 2]
            values = mj_data.sensordata[start : start + mj_model.sensor_dim[sensor]]
            read = values.reshape(slots, -1).any(axis=1)
            if read.sum() > 1:
                return True
    return False


def without_priority(corrections: dict[Any, Any]) -> dict[Any, Any]:
    """Leave out what gives contacts the law of the geom with priority."""
    return {
        hook: needed
        for hook, needed in corrections.items()
        if hook.__name__ != "take_the_law_of_priority"
    }


def without_inertia(read_by_sensors: Callable[..., set[str]]) -> Callable[..., set[str]]:
    """Leave the inertia matrix out of what a refresh computes for sensors."""

    def names(*given: Any) -> set[str]:
        return read_by_sensors(*given) - {"M"}

    return names


def in_substeps_alone(read_state: Callable[..., None]) -> Callable[..., None]:
    """Leave sensors of limits out of a refresh."""

    def read(sensors: Any, *, in_refresh: bool = False) -> None:
        if not in_refresh:
            read_state(sensors)

    return read


_BOXES = r'<(distance|normal|fromto) geom1="box\d" geom2="box\d"'
FAULTS = {
    "small trees": Fault(
        number="1",
        what="small branching models cannot be built",
        place=("newton.limbs", "_suits"),
        instead=gives(several_short_chains),
        needs=("tree.branches",),
        suits=is_small_and_branches,
    ),
    "free bodies": Fault(
        number="2",
        what="between substeps a free body turns by a pose that is not written there",
        place=("native", "headers.text_of"),
        instead=Rewrite(
            lines={
                "    wp::array_t<int> body_freeadr;\n": (
                    "    wp::array_t<int> body_freeadr;\n    wp::array_t<wp::mat33> xmat;\n"
                ),
                "matrix(unit_quat(q + 3));": "world.row_of(a.xmat)[body];",
            },
        ),
        needs=("tree.free", "integrator.implicitfast"),
        kernels="ours",
    ),
    "fixed geoms": Fault(
        number="3",
        what="geoms that are fixed to the world stay where the model has them",
        place=("substeps", "placing_of_fixed_geoms"),
        instead=gives(nothing),
        needs=("field.geom_pos", "static_body"),
    ),
    "disabled actuators": Fault(
        number="4",
        what="actuators of disabled groups act",
        place=("warp_model", "switch_off"),
        instead=gives(nothing),
        needs=("actuatorgroupdisable", "transmission.joint", "actuator.position"),
    ),
    "distances of boxes": Fault(
        number="5",
        what="sensors of distances read nothing of boxes that do not touch",
        place=("contacts", "take_over_measured_boxes"),
        instead=gives(nothing),
        needs=("geom.box",),
        written=_BOXES,
    ),
    "ties": Fault(
        number="6",
        what="rows of connect and weld weigh other bodies than those that they tie",
        place=("substeps", "weighing_of_ties"),
        instead=gives(nothing),
        needs=("equality.weld_world", "tool"),
    ),
    "weights of slides": Fault(
        number="7",
        what="after `set_const` a body that only slides weighs what its tree does",
        place=("constants.masked_constants", "SLIDES_ALONE"),
        instead=gives(-1),
        needs=("tree.slides", "field.body_mass"),
    ),
    "armature of actuators": Fault(
        number="8",
        what="worlds have the model's armature of actuators",
        place=("warp_model", "let_actuators_add"),
        instead=gives(nothing),
        needs=("field.actuator_armature", "transmission.joint"),
    ),
    "priority": Fault(
        number="9",
        what="contacts of geoms with priority mix their laws, where one gives stiffness directly",
        place=("contacts", "CORRECTIONS"),
        instead=without_priority,
        needs=("priority", "direct_solref"),
    ),
    "pairs": Fault(
        number="10",
        what="two pairs of the same geoms count as one",
        place=("upstream", "take_pairs_as_written"),
        instead=gives(nothing),
        needs=("pair_twice", "ground.plane"),
        suits=touches_twice,
    ),
    "bounds of touch": Fault(
        number="11",
        what="touch sensors have no cutoff",
        place=("sensors.sensor_mending", "bounded_touch_sensors"),
        instead=gives(none_of_them),
        needs=("sensor.touch",),
        written=r"<touch [^>]*cutoff",
    ),
    "order of contacts": Fault(
        number="11",
        what="contact sensors have another order",
        place=("sensors.sensor_mending", "contact_sensors_left"),
        instead=gives(none_of_them),
        needs=("reduce.none",),
        written=r'<contact data="(found dist|force)[^>]*reduce="none" num="[2-9]"',
        # One contact alone has no order.
        suits=several_in_a_sensor,
    ),
    "kinetic energy": Fault(
        number="11",
        what="`e_kinetic` after a refresh is of the inertia of the last substep",
        place=("refresh", "Refresh._read_by_sensors"),
        instead=without_inertia,
        needs=("sensor.e_kinetic",),
    ),
    "room to limits": Fault(
        number="11",
        what="`jointlimitpos` after a refresh is of the last substep",
        place=("sensors.limit_sensors", "LimitSensors.read_state"),
        instead=in_substeps_alone,
        needs=("sensor.jointlimitpos",),
    ),
    "pairs of one body": Fault(
        number="11",
        what="pairs of one rigid body have rows, which exert forces",
        place=("contacts", "rows_left_out"),
        instead=gives(nothing),
        needs=("pair",),
        suits=of_one_body,
    ),
    "derivatives that are left": Fault(
        number="11",
        what="without actuation implicit integrators leave out dampers",
        place=("integration.integrators", "_with_all_derivatives"),
        instead=gives(the_first),
        needs=("disable.actuation", "integrator.implicitfast"),
    ),
    "speed of actuators": Fault(
        number="11",
        what="actuators have a velocity where actuation is disabled",
        place=("native", "headers.text_of"),
        instead=Rewrite(
            lines={"ACTUATORS_ACT ? speed : 0.0f": "speed"},
        ),
        needs=("disable.actuation", "transmission.joint"),
        kernels="ours",
    ),
    "free and ball joints": Fault(
        number="11",
        what="actuators of free and ball joints are treated as actuators of hinges",
        place=("smooth.stages", "_has_affine_actuators"),
        instead=gives(yes),
        needs=("transmission.joint",),
        # Sensors name joints, too.
        written=r'<(general|motor|position|velocity|damper|intvelocity)[^>]* joint="(ball|free)\d"',
        kernels="ours",
    ),
    "adhesion of actuators": Fault(
        number="11",
        what="actuators that adhere share their force with pairs that a sensor measures",
        place=("substeps", "miscounts_contacts"),
        instead=gives(no),
        needs=("transmission.body", "sensor.distance"),
    ),
    "height fields": Fault(
        number="12",
        what="contacts with height fields are fewer, and some in other directions",
        place=("contacts", "take_over_height_fields"),
        instead=gives(nothing),
        needs=("ground.hfield", "geom.sphere"),
    ),
    "overflow": Fault(
        number="13",
        what="contacts and rows that find no room are not reported",
        place=("native", "headers.text_of"),
        instead=Rewrite(
            lines={"a.overflow.data[world] | lacking(world, a)": "0"},
        ),
        needs=("tree.free", "geom.box"),
        kernels="ours",
    ),
    "second limits": Fault(
        what="a joint between two near limits has a row for one of them",
        place=("substeps", "adding_of_second_limits"),
        instead=gives(nothing),
        needs=("narrow_limit",),
    ),
    "adhesion of geoms": Fault(
        what="geoms stick at contacts without rows, such as those that a sensor measures",
        place=("contacts", "loose_contacts"),
        instead=gives(nothing),
        needs=("geom_adhesion", "sensor.distance"),
    ),
    "sleep": Fault(
        what="where trees may sleep, a substep reads the state after it",
        place=("integration.integrators", "READ_ONCE"),
        instead=gives(()),
        needs=("enable.sleep", "integrator.Euler", "damping"),
    ),
    "stages of Runge-Kutta": Fault(
        what="forces on bodies belong to the last stage",
        place=("integration.integrators", "FORCES_OF_STAGES"),
        instead=gives(()),
        needs=("integrator.RK4", "tree.arm"),
    ),
    "what acts on free bodies": Fault(
        what="implicit integrators take actuators of a free body for explicit",
        place=("integration.integrators", "full_rows_matter"),
        instead=gives(no),
        needs=("tree.free", "integrator.implicit"),
        written=r"<(position|velocity|damper|general) (joint=.free|site=)",
    ),
    "idle ties": Fault(
        what="ties that no joint can do anything about exert forces",
        place=("substeps", "stilling_of_ties"),
        instead=gives(nothing),
        needs=("equality.weld_world", "tree.slides"),
    ),
}


@contextmanager
def put_back(fault: Fault) -> Iterator[None]:
    """Leave out what mends a fault."""
    owner, name = place_of(fault)
    mends = vars(owner)[name]
    setattr(owner, name, fault.instead(mends))
    try:
        yield
    finally:
        setattr(owner, name, mends)


def place_of(fault: Fault) -> tuple[Any, str]:
    """Return the module or class that has what mends a fault, and its name there."""
    module, path = fault.place
    owner: Any = importlib.import_module(f"{PHYSICS}.{module}")
    *classes, name = path.split(".")
    for each in classes:
        owner = vars(owner)[each]
    return owner, name
