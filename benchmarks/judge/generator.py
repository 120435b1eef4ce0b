"""Draws a model of random features, and which fields its worlds differ in."""

import dataclasses
import xml.etree.ElementTree as ET
from collections import Counter
from functools import cache

import mujoco
import numpy as np

from benchmarks.judge.actuators import SCALAR, TRANSMISSIONS, add_actuators
from benchmarks.judge.bodies import GEOMS, JOINTS, TREES, add_bodies
from benchmarks.judge.draw import Draw, written
from benchmarks.judge.scene import Scene
from benchmarks.judge.sensors import REDUCES, SENSORS, add_sensors
from benchmarks.judge.ties import EQUALITIES, add_equalities, add_pairs, add_tendons
from ksim_rl.physics.load import caught_warnings

INTEGRATORS = ("Euler", "RK4", "implicit", "implicitfast", "discrete")
CONES = ("pyramidal", "elliptic")
JACOBIANS = ("auto", "dense", "sparse")
_DISABLED = (
    "constraint equality frictionloss limit contact spring damper gravity clampctrl warmstart filterparent actuation "
    "refsafe sensor eulerdamp nativeccd island multiccd"
)
DISABLED, ENABLED = tuple(_DISABLED.split()), ("energy", "invdiscrete", "sleep")
# What is refused by name in any model; tests/physics/test_every_option.py has them all. A few models have one.
UNSUPPORTED = (
    ("midphase", "disable"),
    ("autoreset", "disable"),
    ("override", "enable"),
    ("fwdinv", "enable"),
    ("diagexact", "enable"),
    ("speculative", "enable"),
)
# Fields per world; a model has a few of them. Derived fields are requested by the name of their source.
_FIELDS = (
    "body_mass body_ipos body_inertia body_pos body_quat body_gravcomp geom_pos geom_quat geom_size geom_friction "
    "geom_solref geom_margin dof_armature dof_damping dof_frictionloss jnt_range jnt_stiffness jnt_pos qpos0 "
    "qpos_spring actuator_gainprm actuator_biasprm actuator_gear actuator_armature actuator_forcerange eq_solref "
    "tendon_stiffness tendon_damping tendon_range site_pos gravity"
)
FIELDS = tuple(_FIELDS.split())
# What inertia matrices of simple bodies, which are diagonal, depend on.
SPECIALIZED = frozenset(("body_ipos", "jnt_pos"))
FEATURES = (
    *(f"tree.{kind}" for kind in TREES),
    *(f"joint.{kind}" for kind in JOINTS),
    *(f"geom.{kind}" for kind in GEOMS),
    *(f"ground.{kind}" for kind in ("plane", "box", "hfield")),
    *(f"transmission.{kind}" for kind in dict.fromkeys(TRANSMISSIONS)),
    *(f"actuator.{kind}" for kind in SCALAR),
    *(f"equality.{kind}" for kind in EQUALITIES),
    *(f"sensor.{kind}" for kind in SENSORS),
    *(f"reduce.{kind}" for kind in REDUCES),
    *(f"integrator.{kind}" for kind in INTEGRATORS),
    *(f"cone.{kind}" for kind in CONES),
    *(f"disable.{flag}" for flag in DISABLED),
    *(f"enable.{flag}" for flag in ENABLED),
    *(f"field.{name}" for name in FIELDS),
    *(
        "tendon.fixed",
        "tendon.spatial",
        "tendon.wrap",
        "tendon.pulley",
        "tendon.limit",
        "tendon.armature",
    ),
    *(
        "tool",
        "mocap",
        "child_of_mocap",
        "static_body",
        "static_child",
        "keyframe",
        "gravcomp",
        "fluid",
        "wind",
    ),
    *(
        "actuatorgroupdisable",
        "pair",
        "pair_twice",
        "exclude",
        "priority",
        "direct_solref",
        "gap",
        "narrow_limit",
    ),
    *(
        "limit",
        "joint_frictionloss",
        "actuator_armature",
        "actuator_delay",
        "sensor_delay",
        "sensor_cutoff",
    ),
    *("fluid_shape", "geom_adhesion", "surfacevel", "condim", "forces"),
)
# What a feature cannot do without, by the begin of its name.
IMPLIED = {
    "transmission.tendon": ("tendon.fixed",),
    "equality.tendon": ("tendon.fixed",),
    "equality.joint": ("joint.hinge", "tree.arm"),
    "field.tendon_range": ("tendon.fixed", "tendon.limit"),
    "field.tendon": ("tendon.fixed",),
    "field.eq": ("equality.weld_world",),
    "field.actuator": ("transmission.joint",),
    "field.jnt_range": ("limit",),
    "field.jnt_stiffness": ("stiffness",),
    "sensor.tendonlimit": ("tendon.fixed", "tendon.limit"),
    "sensor.tendon": ("tendon.fixed",),
    "sensor.jointlimit": ("limit",),
    "sensor.ball": ("joint.ball", "tree.arm"),
    "sensor.actuator": ("transmission.joint",),
    "sensor.camprojection": ("camera",),
    "sensor.insidesite": ("tree.free",),
    "reduce.": ("sensor.contact",),
    "tendon.wrap": ("tendon.spatial", "geom.sphere"),
    "tendon.pulley": ("tendon.spatial",),
    "tendon.": ("tendon.fixed",),
    "actuator.": ("transmission.joint", "tree.arm"),
    "actuator_": ("transmission.joint", "tree.arm"),
    "actuatorgroupdisable": ("transmission.joint",),
    "child_of_mocap": ("mocap",),
    "static_child": ("static_body",),
    "pair_twice": ("pair",),
    "narrow_limit": ("limit", "joint.hinge"),
    "fluid_shape": ("fluid",),
}
# What our kernels leave to MuJoCo Warp's, by the begin of its name. Every other model has nothing of it.
FOREIGN = (
    *(
        "tendon.",
        "fluid",
        "wind",
        "geom_adhesion",
        "springyield",
        "noslip",
        "unsupported",
        "actuator_delay",
    ),
    *(
        "sensor_delay",
        "sensor.tendon",
        "sensor.e_",
        "field.tendon",
        "field.eq",
        "enable.",
        "disable.warmstart",
    ),
    *(
        "transmission.jointinparent",
        "transmission.slidercrank",
        "transmission.tendon",
        "transmission.site",
    ),
    *(
        "transmission.refsite",
        "transmission.body",
        "actuator.muscle",
        "actuator.dcmotor",
        "actuator.damper",
    ),
    *(
        "equality.connect",
        "equality.weld",
        "equality.tendon",
        "integrator.RK4",
        "integrator.discrete",
    ),
    *("jacobian.dense",),
)
# A feature that fewer models of a hunt have is rare, and asked for: of so many in a model at most.
SHARE, DEALT = 0.08, 16


@dataclasses.dataclass(frozen=True, kw_only=True)
class Generated:
    """A random model.

    Attributes:
        seed, number: what it was drawn from.
        xml: the model.
        features: what it was given.
        fields: the fields in which its worlds differ.
    """

    seed: int
    number: int
    xml: str
    features: frozenset[str]
    fields: tuple[str, ...]


class _Hunt:
    """The models of a seed, in order: each is asked for what is rare among the ones before it."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._models: list[Generated] = []
        self._counts: Counter[str] = Counter()

    def wishes(self, number: int) -> tuple[str, ...]:
        """Return what a model is asked for: of the features that it may have, those that are rare before it."""
        self._draw(number)
        counts = Counter(self._counts)
        for found in self._models[number:]:
            counts.subtract(found.features)
        enough = SHARE * (number + 1)
        rare = [name for name in allowed_of(number) if counts[name] < enough]
        # Of those that are equally rare, any.
        shuffled = np.random.default_rng((self._seed, number)).permutation(rare)
        rarest = sorted(shuffled, key=lambda name: counts[name])
        return tuple(str(name) for name in rarest[:DEALT])

    def model(self, number: int) -> Generated:
        """Return the model of a number."""
        self._draw(number + 1)
        return self._models[number]

    def _draw(self, count: int) -> None:
        for number in range(len(self._models), count):
            found = compiled(self._seed, number, self.wishes(number))
            self._models.append(found)
            self._counts.update(found.features)


@cache
def _hunt(seed: int) -> _Hunt:
    return _Hunt(seed)


def generate(seed: int, number: int) -> Generated:
    """Return the model of a number in the hunt of a seed."""
    return _hunt(seed).model(number)


def dealt(seed: int, number: int) -> tuple[str, ...]:
    """Return the features that a model of a hunt is asked for: those that are rare among the ones before it."""
    return _hunt(seed).wishes(number)


def compiled(seed: int, number: int, wishes: tuple[str, ...]) -> Generated:
    """Draw a model that MuJoCo compiles, with these features where it can have them."""
    for attempt in range(20):
        found = _drawn(seed, number, attempt, wishes)
        with caught_warnings() as warned:
            try:
                mj_model = mujoco.MjModel.from_xml_string(found.xml)
            except ValueError:
                continue
        # Of joints that do the same thing twice.
        if not any("singular" in text for text in warned):
            return with_keyframe(found, mj_model)
    raise ValueError(f"seed {seed}, model {number}: MuJoCo refused 20 models in a row")


def with_keyframe(found: Generated, mj_model: mujoco.MjModel) -> Generated:
    """Return a model with a keyframe, if it shall have one: only now is the number of its coordinates known."""
    if "keyframe" not in found.features:
        return found
    rng = np.random.default_rng((found.seed, found.number))
    qpos = mj_model.qpos0.copy()
    mujoco.mj_integratePos(mj_model, qpos, 0.1 * rng.normal(size=mj_model.nv), 1.0)
    qvel = 0.3 * rng.normal(size=mj_model.nv)
    key = f'<keyframe><key name="home" qpos="{written(qpos)}" qvel="{written(qvel)}"/></keyframe>'
    return dataclasses.replace(found, xml=found.xml.replace("</mujoco>", f"{key}\n</mujoco>"))


def barred(number: int) -> tuple[str, ...]:
    """Return what a model of a hunt has nothing of."""
    return FOREIGN if number % 2 else ()


def allowed_of(number: int) -> list[str]:
    """Return the features that a model of a hunt may have."""
    without = barred(number)
    return [name for name in FEATURES if not name.startswith(without)]


def implied(features: tuple[str, ...]) -> frozenset[str]:
    """Return features, and what they cannot do without."""
    found = set(features)
    for feature in features:
        begin = next((begin for begin in IMPLIED if feature.startswith(begin)), None)
        if begin is not None:
            found.update(IMPLIED[begin])
    return frozenset(found)


def _drawn(seed: int, number: int, attempt: int, wishes: tuple[str, ...]) -> Generated:
    draw = Draw(np.random.default_rng((seed, number, attempt)), implied(wishes), barred(number))
    scene = Scene()
    add_bodies(scene, draw)
    add_tendons(scene, draw)
    add_equalities(scene, draw)
    add_pairs(scene, draw)
    add_actuators(scene, draw)
    add_sensors(scene, draw)
    option = _option(draw)
    fields = _fields(scene, draw)
    draw.takes("forces", 0.3)
    draw.takes("keyframe", 0.1)
    if SPECIALIZED.intersection(fields) or (fields and number % 3):
        # As prepare_spec does: what the compiler specializes on must not differ.
        for body in scene.worldbody.iter("body"):
            body.set("simple", "false")
    return Generated(
        seed=seed,
        number=number,
        xml=scene.text(option, []),
        features=frozenset(draw.taken),
        fields=fields,
    )


def _option(draw: Draw) -> ET.Element:
    option = ET.Element("option", timestep=draw.any(("0.002", "0.004")))
    option.set(
        "integrator",
        draw.kind("integrator", (*INTEGRATORS, "Euler", "implicitfast", "implicitfast")),
    )
    option.set("cone", draw.kind("cone", CONES))
    option.set("jacobian", draw.kind("jacobian", ("auto", *JACOBIANS, "sparse")))
    if draw.takes("impratio", 0.3):
        option.set("impratio", draw.any(("3", "10")))
    if draw.takes("gravity", 0.3):
        option.set("gravity", draw.numbers(-5.0, 0.0, 3))
    if draw.takes("fluid", 0.1):
        option.set("density", draw.any(("1.2", "200")))
        option.set("viscosity", draw.any(("0.00002", "0.3")))
    if draw.takes("wind", 0.05):
        option.set("wind", "1 -2 0.5")
        option.set("density", "100")
    if draw.takes("magnetic", 0.1):
        option.set("magnetic", "0.3 -0.2 0.4")
    if draw.takes("noslip", 0.02):
        option.set("noslip_iterations", "3")
    if draw.takes("actuatorgroupdisable", 0.1):
        option.set("actuatorgroupdisable", draw.any(("0", "1", "1 2")))
    flag = ET.Element("flag")
    for name in DISABLED:
        if draw.takes(f"disable.{name}", 0.01):
            flag.set(name, "disable")
    for name in ENABLED:
        if draw.takes(f"enable.{name}", 0.01):
            flag.set(name, "enable")
    if draw.takes("unsupported", 0.03):
        flag.set(*UNSUPPORTED[int(draw.rng.integers(len(UNSUPPORTED)))])
    if flag.attrib:
        option.append(flag)
    return option


def _fields(scene: Scene, draw: Draw) -> tuple[str, ...]:
    """Draw the fields in which the worlds of a model differ: those that are wanted, and at times another."""
    has = {
        "actuator": bool(scene.actuators),
        "eq": len(scene.equality) > 0,
        "tendon": len(scene.tendon) > 0,
        "jnt": bool(scene.joints),
        "site": bool(scene.sites),
    }
    return tuple(
        name
        for name in FIELDS
        if has.get(name.split("_")[0], True) and draw.takes(f"field.{name}", 0.02)
    )
