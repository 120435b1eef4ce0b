"""Which quantities of a world differ from the C engine's by more than rounding does."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

import mujoco
import numpy as np

from benchmarks.judge import c_engine
from benchmarks.judge.worlds import Arrays, jacobian_rounding, perturbed, rounded

# Relative to the scale of a quantity: of what follows from the state, and of what a solver finds.
DIRECT, SOLVED = 1e-4, 1e-3
# How many times the change that rounding makes in C.
TIMES = 30.0
# The least scale of a quantity, in its units; a sensor has the scale of the quantity that it reads.
LEAST_SCALE = {"qacc": 10.0, "cacc": 10.0, "cfrc_int": 5.0, "cfrc_ext": 5.0}
LEAST_SCALE |= dict.fromkeys(("sensor force", "sensor torque"), LEAST_SCALE["cfrc_int"])
LEAST_SCALE |= dict.fromkeys(
    ("sensor accelerometer", "sensor framelinacc", "sensor frameangacc"), LEAST_SCALE["cacc"]
)
# What follows from poses, and from the state that a substep starts from.
OF_POSES = (
    *(
        "qpos",
        "act",
        "time",
        "plastic",
        "actuator_length",
        "ten_length",
        "cinert",
        "subtree_com",
        "xanchor",
        "xaxis",
    ),
    *(
        "xpos",
        "xquat",
        "xmat",
        "xipos",
        "ximat",
        "geom_xpos",
        "geom_xmat",
        "site_xpos",
        "site_xmat",
    ),
    *("cam_xpos", "cam_xmat", "light_xpos", "light_xdir"),
)
OF_THE_START = ("act_dot", "actuator_force", "actuator_velocity", "qfrc_actuator", "qfrc_passive")
PERTURBATIONS = 10


@dataclasses.dataclass(frozen=True, kw_only=True)
class Finding:
    """A quantity that differs.

    Attributes:
        quantity: its name; of sensors "sensor", the type and the name.
        error: the largest difference from C, in the quantity's units.
        limit: what was allowed.
        world: in which world.
        when: after which calls.
    """

    quantity: str
    error: float
    limit: float
    world: int
    when: str

    @property
    def kind(self) -> str:
        """What a shrunk model must still fail in: the quantity, of sensors their type."""
        return kind_of(self.quantity)


def kind_of(quantity: str) -> str:
    """Return a quantity without the name of a sensor: of sensors their type."""
    words = quantity.split()
    return " ".join(words[:2]) if words[0] == "sensor" else words[0]


def limit_of(mj_model: mujoco.MjModel, quantity: str, substeps: int) -> float:
    """Return the relative limit of a quantity: velocities that were reached are what the solver found.

    It does not grow with the substeps: by how much they carry an error on, C's own change says.
    """
    if quantity.startswith("sensor"):
        stage = mj_model.sensor_needstage[mj_model.sensor(quantity.split()[2]).id]
        is_direct = stage == mujoco.mjtStage.mjSTAGE_POS
    else:
        # Of Runge-Kutta they are of its last stage, whose velocities a solver found.
        of_the_start = substeps == 1 and mj_model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4
        is_direct = quantity in OF_POSES or (of_the_start and quantity in OF_THE_START)
    return DIRECT if is_direct else SOLVED


def differences(
    mj_model: mujoco.MjModel,
    state: Arrays,
    substeps: int,
    actual: Mapping[str, np.ndarray],
    expected: Mapping[str, np.ndarray],
    *,
    scales: Mapping[str, float],
    seed: int,
    world: int,
    when: str,
) -> list[Finding]:
    """Return what differs in one world, by more than the limits and than rounding of C's state explains."""
    suspects = {}
    for name, wanted in expected.items():
        if name not in actual:
            continue
        error = _distance(actual[name], wanted)
        limit = limit_of(mj_model, name, substeps) * scales[name]
        if not error <= limit:
            suspects[name] = (error, limit)
    changes = dict.fromkeys(suspects, 0.0)
    for other in _rounded_otherwise(mj_model, state, substeps, seed) if suspects else ():
        for name in suspects:
            changes[name] = max(changes[name], _distance(other[name], expected[name]))
    return [
        Finding(
            quantity=name,
            error=error,
            limit=max(limit, TIMES * changes[name]),
            world=world,
            when=when,
        )
        for name, (error, limit) in suspects.items()
        if not error <= max(limit, TIMES * changes[name])
    ]


def _rounded_otherwise(
    mj_model: mujoco.MjModel, state: Arrays, substeps: int, seed: int
) -> Iterator[Arrays]:
    """Yield what C computes where float32 rounds: its model, and then its state and the Jacobian of its constraints."""
    yield c_engine.run(rounded(mj_model), state, substeps)[0]
    noise = jacobian_rounding(mj_model, state)
    for draw in range(PERTURBATIONS):
        rng = np.random.default_rng((seed, draw))
        other = perturbed(state, rng)
        other["qfrc_applied"] = other["qfrc_applied"] + noise * rng.choice(
            (-1.0, 1.0), size=mj_model.nv
        )
        yield c_engine.run(mj_model, other, substeps)[0]


def scales_of(worlds: Sequence[Mapping[str, np.ndarray]]) -> dict[str, float]:
    """Return the scale of each quantity: its largest value in C's worlds, and the least one of its kind at least."""
    found: dict[str, float] = {}
    for quantities in worlds:
        for name, value in quantities.items():
            largest = float(np.abs(value).max(initial=0.0))
            least = LEAST_SCALE.get(kind_of(name), 1.0)
            found[name] = max(found.get(name, least), largest)
    return found


def _distance(actual: np.ndarray, wanted: np.ndarray) -> float:
    if actual.size != wanted.size:
        return np.inf
    difference = np.abs(actual.reshape(wanted.shape) - wanted)
    return float(difference.max(initial=0.0))
