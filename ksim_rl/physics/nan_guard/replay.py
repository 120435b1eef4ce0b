"""Replays the last substeps of a world that became non-finite on MuJoCo's C engine.

    python -m ksim_rl.physics.nan_guard.replay FILE

Each row starts the C engine from the state that MuJoCo Warp had before that substep, with the same controls, applied
forces and model fields, and takes one step in double precision.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from ksim_rl.physics.fields import write_fields
from ksim_rl.physics.load import caught_warnings
from ksim_rl.physics.nan_guard.failures import Failure, read
from ksim_rl.terminal import show

# The C engine sets all controls to zero if one exceeds 1e10 or is not finite.
MOST_CONTROL = 1e9
_WARNINGS = {
    mujoco.mjtWarning.mjWARN_INERTIA: "singular inertia",
    mujoco.mjtWarning.mjWARN_CONTACTFULL: "contacts full",
    mujoco.mjtWarning.mjWARN_CNSTRFULL: "constraints full",
    mujoco.mjtWarning.mjWARN_BADQPOS: "bad qpos",
    mujoco.mjtWarning.mjWARN_BADQVEL: "bad qvel",
    mujoco.mjtWarning.mjWARN_BADQACC: "bad qacc",
    mujoco.mjtWarning.mjWARN_BADCTRL: "bad ctrl",
}


@dataclass(frozen=True, kw_only=True)
class Substep:
    """One substep on the C engine, from the state that Warp had before it.

    `time` (s), `energy` (kinetic and potential, J) and `speed` are those before it. Speed, acceleration and control are
    the largest |qvel|, |qacc| and |ctrl|, each with its dof or actuator (0 and -1 where there is none); for the
    acceleration, controls beyond 1e9 count as 1e9, since the C engine would drop all of them. `deviation` is the
    largest difference between the velocities that both engines reach: large also where an event or a reset changed the
    state between two substeps.
    """

    time: float
    energy: float
    speed: tuple[float, int]
    acceleration: tuple[float, int]
    control: tuple[float, int]
    contacts: int
    warnings: tuple[str, ...]
    deviation: float


@dataclass(frozen=True, kw_only=True)
class Replay:
    """A failure as the C engine replays it; the last of `substeps` is the one that broke on Warp.

    `dofs` are those whose velocities or positions are not finite after it. `first` is the dof that broke first: Warp's
    solver spreads a non-finite number over all dofs of a world within one substep, so it is then the one with the
    largest acceleration on the C engine, which does not, as it is where all numbers are finite, but too large to be
    added up. `was_broken_before` says that something wrote a non-finite number into the state before it, `breaks_on_c`
    that the C engine warns of a bad state in that substep too, or leaves it with non-finite numbers.
    """

    substeps: tuple[Substep, ...]
    dofs: tuple[int, ...]
    first: int
    was_broken_before: bool
    breaks_on_c: bool


def replay(failure: Failure) -> Replay:
    """Run each kept substep on the C engine, which reports bad states instead of resetting them."""
    mj_model = failure.mj_model
    write_fields(mj_model, failure.fields)
    # C would reset a diverged state by itself, which hides what is looked for.
    mj_model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    mj_model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    # One data for all substeps: each starts from its own kept state.
    data = mujoco.MjData(mj_model)
    # Each substep reaches the state from which the next one starts; the last one's was kept apart.
    reached_qvel = [*failure.states["qvel"][1:], failure.reached["qvel"]]
    # Overflows in numpy and warnings of MuJoCo are the subject here, not faults.
    with np.errstate(all="ignore"), caught_warnings():
        substeps = tuple(
            _substep(data, failure, k, reached) for k, reached in enumerate(reached_qvel)
        )
    before = _broken_dofs(mj_model, failure.states["qpos"][-1], failure.states["qvel"][-1])
    after = _broken_dofs(mj_model, failure.reached["qpos"], failure.reached["qvel"])
    finite = np.isfinite(data.qpos).all() and np.isfinite(data.qvel).all()
    # Warp's solver spreads NaN over all dofs, so that their numbers say nothing of where it began.
    spread = len(after) in (0, mj_model.nv) and not before
    return Replay(
        substeps=substeps,
        dofs=after,
        first=substeps[-1].acceleration[1] if spread else (before or after)[0],
        was_broken_before=bool(before),
        breaks_on_c=not finite or any(text.startswith("bad") for text in substeps[-1].warnings),
    )


def dof_name(mj_model: mujoco.MjModel, dof: int) -> str:
    """Return the name of a dof: its joint's, with the place in it for joints of several dofs."""
    joint = int(mj_model.dof_jntid[dof])
    name = mj_model.joint(joint).name or f"joint {joint}"
    # A free joint has six dofs and a ball three: their place is shown.
    several = mj_model.jnt_type[joint] in (
        int(mujoco.mjtJoint.mjJNT_FREE),
        int(mujoco.mjtJoint.mjJNT_BALL),
    )
    if several:
        return f"{name}[{dof - int(mj_model.jnt_dofadr[joint])}]"
    return name


def describe(failure: Failure, result: Replay, *, limit: int = 10) -> str:
    """Return the replay as a table, with the verdict below it."""
    mj_model = failure.mj_model
    heads = "substep,time s,energy J,max |qvel|,of dof,max |qacc|,of dof,max |ctrl|,contacts,off Warp,C engine"
    # The head is a row as well, so that columns are as wide as both.
    rows: list[tuple[str, ...]] = [tuple(heads.split(","))]
    last = len(result.substeps) - 1
    for k, substep in enumerate(result.substeps):
        (speed, fast) = substep.speed
        (acceleration, pushed) = substep.acceleration
        numbers = (
            f"{substep.time:.4f}",
            _short(substep.energy),
            _short(speed),
            dof_name(mj_model, fast),
        )
        numbers += (_short(acceleration), dof_name(mj_model, pushed), _short(substep.control[0]))
        said = ", ".join(substep.warnings) or "ok"
        rows.append(
            (str(k - last), *numbers, str(substep.contacts), _short(substep.deviation), said)
        )
    widths = []
    for column in zip(*rows, strict=True):
        widths.append(max(len(cell) for cell in column))
    lines = []
    for row in rows:
        cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=True)]
        lines.append("  ".join(cells))
    names = [dof_name(mj_model, dof) for dof in result.dofs]
    shown = ", ".join(names[:limit]) + (
        f" and {len(names) - limit} more" if len(names) > limit else ""
    )
    kept = len(result.substeps)
    title = f"world {failure.world}: its last {kept} of {failure.substep} substeps; 0 is the one that broke"
    first = dof_name(mj_model, result.first)
    # A state that was broken before is no fault of the physics.
    if result.was_broken_before:
        verdict = f"First: {first}, before substep 0 already. An event, a command or a reset wrote it there."
    else:
        verdict = (
            f"First: {first}. Not finite after substep 0 on Warp: {shown or 'the sum of all'}."
        )
    lines = [title, *lines, verdict]
    size, actuator = result.substeps[-1].control
    if size > MOST_CONTROL:
        lines.append(
            f"The control of actuator {mj_model.actuator(actuator).name!r} is {_short(size)}."
        )
    lines.append(
        f"The C engine {'breaks in the same' if result.breaks_on_c else 'takes the'} substep."
    )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table of a file."""
    parser = argparse.ArgumentParser(
        prog="python -m ksim_rl.physics.nan_guard.replay",
        description="Show the step that became non-finite.",
    )
    parser.add_argument("file", type=Path, help="a file that the NaN guard wrote (sim.nan_guard)")
    path = parser.parse_args(arguments).file
    try:
        failure = read(path)
    except (ValueError, OSError) as error:
        show(f"error: {error}", to_stderr=True)
        return 1
    show(describe(failure, replay(failure)))
    return 0


def _substep(data: mujoco.MjData, failure: Failure, k: int, reached_qvel: np.ndarray) -> Substep:
    mj_model = failure.mj_model
    # Warm starts and warnings of the substep before must not leak into this one.
    mujoco.mj_resetData(mj_model, data)
    for name, values in failure.states.items():
        if name == "time":
            data.time = float(values[k, 0])
        else:
            target = getattr(data, name)
            target[:] = values[k].reshape(target.shape)
    speed = _largest(data.qvel)
    control = _largest(data.ctrl)
    # The C engine zeroes all controls if one is too large: acceleration is taken with clipped ones.
    given = data.ctrl.copy()
    data.ctrl[:] = np.clip(np.nan_to_num(given), -MOST_CONTROL, MOST_CONTROL)
    mujoco.mj_forward(mj_model, data)
    # The step itself gets the controls as they were.
    data.ctrl[:] = given
    # Readings of the state before the step, which `mj_step` overwrites.
    energy = float(data.energy.sum())
    contacts = int(data.ncon)
    acceleration = _largest(data.qacc)
    time = float(data.time)
    mujoco.mj_step(mj_model, data)
    return Substep(
        time=time,
        energy=energy,
        speed=speed,
        acceleration=acceleration,
        control=control,
        contacts=contacts,
        warnings=tuple(text for kind, text in _WARNINGS.items() if data.warning[kind].number),
        deviation=_largest(data.qvel - reached_qvel)[0],
    )


def _largest(values: np.ndarray) -> tuple[float, int]:
    """Return the largest magnitude and its place; a number that is not finite is the largest."""
    if not values.size:
        return 0.0, -1
    # Non-finite numbers sort as the largest.
    size = np.where(np.isfinite(values), np.abs(values), np.inf)
    place = int(np.argmax(size))
    return float(size[place]), place


def _broken_dofs(mj_model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray) -> tuple[int, ...]:
    broken = ~np.isfinite(qvel)
    for joint in range(mj_model.njnt):
        start = int(mj_model.jnt_qposadr[joint])
        if joint + 1 < mj_model.njnt:
            # Positions of a joint lie between its address and the next one's.
            end = int(mj_model.jnt_qposadr[joint + 1])
        else:
            end = mj_model.nq
        # A broken position counts for all dofs of its joint, unless a velocity tells which one.
        is_of_joint = mj_model.dof_jntid == joint
        is_finite = np.isfinite(qpos[start:end]).all()
        if not is_finite and not broken[is_of_joint].any():
            broken[is_of_joint] = True
    return tuple(int(dof) for dof in np.flatnonzero(broken))


def _short(value: float) -> str:
    return f"{value:.4g}"


if __name__ == "__main__":
    raise SystemExit(main())
