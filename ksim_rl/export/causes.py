"""Finds the reason why a policy acts differently in another simulator, from single steps that both have taken.

Each recorded step is taken once more there, from the recorded state, with the recorded observation and action. So each
link of the chain is compared by itself: observation, policy, target, effort, motion. A link that differs hides those
that follow from it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ksim_rl.export.standalone.description import Export

Arrays = Mapping[str, np.ndarray]
SAME = 2e-3
LIKE = 2e-2
"""Relative errors: up to SAME two signals count as equal, up to LIKE a reason explains their difference."""
MOST_OFF = 0.2
"""Share of pixels in which two renderers may differ: edges, lights and textures are not drawn alike."""
# A signal may be late or early by so many env steps and still be recognized.
MOST_SHIFT = 4


@dataclass(frozen=True)
class Cause:
    """A likely cause, the part that it concerns, and the evidence."""

    name: str
    about: str
    evidence: str

    def __str__(self) -> str:
        return f"{self.name}: {self.about}: {self.evidence}"


def find_causes(meta: Export, trace: Arrays, replay: Arrays) -> list[Cause]:
    """Return the likely causes of differences, the first in the chain first.

    `trace` holds recorded steps, `trace/<signal>` [N, T, ...]; `replay` the same from elsewhere, `<lag>/<n>/<signal>`.
    """
    found: list[Cause] = []
    # Rates first: with another step nothing later in the chain can agree.
    recorded_s = float(trace["trace/dt"]) * int(trace["trace/decimation"])
    step_s = float(replay["dt"]) * int(replay["decimation"])
    substep_s = float(replay["dt"])
    if (
        abs(step_s / recorded_s - 1.0) > 1e-6
        or abs(substep_s / float(trace["trace/dt"]) - 1.0) > 1e-6
    ):
        evidence = (
            f"{step_s:g} s in steps of {substep_s:g} s, trained with {recorded_s:g} s in steps of "
        )
        found.append(Cause("rate", "env step", evidence + f"{float(trace['trace/dt']):g} s"))

    for camera, share in pictures_off(meta, replay).items():
        if not share <= MOST_OFF:
            found.append(
                Cause("picture", f"camera {camera!r}", f"{share:.0%} of its pixels are others")
            )

    signal = partial(_pairs, trace=trace, replay=replay)
    causes, obs_differs = _of_observations(meta, trace, replay)
    found += causes
    # The network itself: it was given the recorded observation, so only its file can explain a difference.
    ours, theirs, _ = signal("action")
    # With a history or a recurrent state the runner feeds its own frames, and inherits their errors.
    size = sum(term["size"] for term in meta["observations"])
    remembers = trace["trace/obs"].shape[-1] != size
    if _error(ours, theirs) > SAME and not (remembers and obs_differs):
        # Columns in another order are the most common mistake, and would also look like a wrong normalizer.
        if order := _order(ours, theirs):
            found.append(
                Cause("joint order", "policy.onnx", f"its actions match ours in the order {order}")
            )
        else:
            found.append(
                Cause(
                    "normalizer",
                    "policy.onnx",
                    f"same observation, actions {_error(ours, theirs):.0%} off",
                )
            )
    # An actuator that drives another joint explains all motion, so nothing else is looked for then.
    driven = [joint for law in meta["actuators"] for joint in law["joints"]]
    crossed = [joint for joint, wrong in zip(driven, replay["crossed"], strict=True) if wrong]
    if crossed:
        evidence = f"the actuators of {', '.join(crossed)} drive other joints"
        found.append(Cause("joint order", "robot.xml", evidence))
    elif motion := _of_motion(meta, signal, rates=not found or found[0].name != "rate"):
        found.append(motion)
    return found


def _of_observations(meta: Export, trace: Arrays, replay: Arrays) -> tuple[list[Cause], bool]:
    """Return the causes among the terms of the observation, and whether any term differs."""
    found: list[Cause] = []
    # A policy that only sees has no terms.
    if not meta["observations"]:
        return found, False
    # Histories are cut to their newest frame, which the replay gives too.
    frames = _newest(meta, trace["trace/obs"])
    ours, theirs, episode = _pairs("obs", {**trace, "trace/obs": frames}, replay)
    start = 0
    differs = False
    for term in meta["observations"]:
        columns = slice(start, start + term["size"])
        start += term["size"]
        causes = _of_observation(term["name"], ours[:, columns], theirs[:, columns], episode)
        differs = differs or bool(causes)
        # The last action follows from the action chain, which the targets show.
        found += [] if term["reads"] == ["action"] else causes
    return found, differs


def pictures_off(meta: Export, replay: Arrays) -> dict[str, float]:
    """Return the mean share of pixels that are drawn otherwise in the recorded states, by camera."""
    found = {}
    for spec in meta.get("pictures", []):
        ending = f"/off_{spec['group']}"
        shares = [values for name, values in replay.items() if name.endswith(ending)]
        found[str(spec["camera"])] = float(np.mean(np.concatenate(shares)))
    return found


def _of_motion(meta: Export, signal: Any, *, rates: bool) -> Cause | None:
    """Return the first difference on the way from the action to the next state."""
    joints = meta["joints"]["names"]
    # Targets come straight from the action: no physics is in them yet.
    ours, theirs, episode = signal("target")
    if _error(ours, theirs) > SAME:
        return _of_targets(ours, theirs, episode, joints)
    # At another rate efforts and velocities differ in any case.
    if not rates:
        return None
    # Efforts follow from target and state, and so show gains and lags of actuators.
    ours, theirs, episode = signal("effort")
    if _error(ours, theirs) > LIKE:
        # Looser than elsewhere: efforts also change with the state.
        if shift := _shift(ours, theirs, episode, tolerance=0.2):
            return Cause("delay", "actuators", f"efforts are {shift} steps old")
        # The joint whose gain is furthest from ours, up or down; the small number keeps the logarithm finite.
        ratios = _ratios(ours, theirs)
        worst = int(np.abs(np.log(np.abs(ratios) + 1e-9)).argmax())
        off = np.abs(ratios - 1.0) > LIKE
        # Other masses and contacts move joints within the step, and change efforts without a common factor.
        if off.any() and _error(ours * ratios, theirs) <= 0.3 * _error(ours, theirs):
            evidence = f"same state and target, effort x {ratios[worst]:.2f}; {int(off.sum())} joints differ"
            return Cause("gain", joints[worst], evidence)
    # What is left is physics. Contact in either engine counts as contact.
    ours, theirs, _ = signal("next_qvel")
    before, _, _ = signal("qvel")
    error = np.abs(ours - theirs).max(1)
    # Of what the step itself changed; where nothing moves, float32's rounding is no cause.
    size = np.abs(ours - before).mean() + 1e-4
    touches = np.zeros(len(error), bool)
    for name in meta["contacts"]:
        found_here, found_there, _ = signal(f"found_{name}")
        touches |= (found_here > 0).any(1)
        touches |= (found_there > 0).any(1)
    on_ground = _mean_of(error, touches) / size
    in_air = _mean_of(error, ~touches) / size
    # Rounding and the tolerance of the solvers stay below this.
    if max(on_ground, in_air) <= 3 * SAME:
        return None
    evidence = f"velocities {on_ground:.1%} off with contact, {in_air:.1%} without"
    # In the air only masses count: an error on the ground alone is one of contacts.
    if on_ground > 5 * in_air:
        return Cause("contact parameters", "robot.xml", evidence)
    return Cause("mass or inertia", "robot.xml", evidence)


def _mean_of(error: np.ndarray, rows: np.ndarray) -> float:
    """Return the mean of these rows, 0 where there are none."""
    if not rows.any():
        return 0.0
    return float(np.mean(error[rows]))


def _of_observation(
    name: str, ours: np.ndarray, theirs: np.ndarray, episode: np.ndarray
) -> list[Cause]:
    if _error(ours, theirs) <= SAME:
        return []
    about = f"observation {name!r}"
    # From the most particular reason to the most general: a factor would fit many others badly, too.
    if shift := _shift(ours, theirs, episode):
        return [Cause("stale sensor", about, f"it is {shift} steps old")]
    if order := _order(ours, theirs):
        return [Cause("joint order", about, f"its columns match ours in the order {order}")]
    ratios = _ratios(ours, theirs)
    if _error(ours * ratios, theirs) <= LIKE:
        return [Cause("scale", about, f"x {np.median(ratios):.3g}")]
    # Only vectors of three can be turned.
    if ours.shape[1] % 3 == 0:
        our_lengths = np.linalg.norm(ours.reshape(-1, 3), axis=1)
        their_lengths = np.linalg.norm(theirs.reshape(-1, 3), axis=1)
        # A sensor that does not sit in the body's origin feels its turning too.
        most = max(LIKE, 0.3 * _error(ours, theirs))
        if _error(our_lengths, their_lengths) <= most:
            return [
                Cause("frame", about, "lengths agree, directions do not: it is given in other axes")
            ]
    # After removing the means, only a constant difference is explained.
    if _error(ours - ours.mean(0), theirs - theirs.mean(0)) <= LIKE:
        return [
            Cause("offset", about, f"shifted by {np.round((theirs - ours).mean(0), 3).tolist()}")
        ]
    return [
        Cause(
            "observation",
            about,
            f"{_error(ours, theirs):.0%} off, for no reason that is known here",
        )
    ]


def _of_targets(
    ours: np.ndarray, theirs: np.ndarray, episode: np.ndarray, joints: list[str]
) -> Cause:
    # Columns are position, velocity and effort of all joints, hence the remainder.
    if order := _order(ours, theirs):
        moved = [joints[a % len(joints)] for a, b in enumerate(order) if a != b]
        return Cause(
            "joint order", "targets", f"{', '.join(moved)} get the targets of other joints"
        )
    if shift := _shift(ours, theirs, episode):
        return Cause("delay", "targets", f"they are {shift} steps old")
    # A factor or shift by column explains it; about the mean, the two are told apart.
    if _unlike(ours, theirs) <= LIKE:
        ratios = _ratios(ours - ours.mean(0), theirs - theirs.mean(0))
        if np.abs(ratios - 1.0).max() <= LIKE:
            return Cause("offset", "targets", "they move as ours do about another default pose")
        return Cause(
            "scale",
            "targets",
            f"x {ratios[np.abs(ratios - 1.0).argmax()]:.3g} about the default pose",
        )
    return Cause(
        "delay",
        "targets",
        f"{_error(ours, theirs):.0%} off, and more as actions change: a filter or a lag",
    )


def _pairs(name: str, trace: Arrays, replay: Arrays) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a signal as recorded and as replayed, [M, L] each, and the episode of each row.

    Of the lags that an episode may have had, the one that fits is taken, whatever the scale.
    """
    ours = []
    theirs = []
    episode = []
    # Each possible lag was replayed, under "<lag>/<episode>/<signal>".
    lags = sorted({key.split("/")[0] for key in replay if "/" in key})
    for number, recorded in enumerate(trace[f"trace/{name}"]):
        keys = [f"{lag}/{number}/{name}" for lag in lags]
        fits = [replay[key] for key in keys if key in replay]
        # Up to the first end; the appended True ends an episode that has none.
        is_end = trace["trace/done"][number].ravel() > 0
        length = int(np.argmax(np.append(is_end, True))) + 1
        flat = recorded[:length].reshape(min(length, len(recorded)), -1)
        found = [fit[: len(flat)].reshape(len(flat), -1) for fit in fits] or [flat]
        ours.append(flat)
        theirs.append(min(found, key=lambda fit: _unlike(flat, fit)))
        episode.append(np.full(len(flat), number))
    return np.concatenate(ours), np.concatenate(theirs), np.concatenate(episode)


def _newest(meta: Export, obs: np.ndarray) -> np.ndarray:
    """Return the newest frame [..., L] of vectors that hold histories."""
    columns = []
    stop = 0
    # A term's frames stand side by side, the oldest first.
    for term in meta["observations"]:
        stop += term["size"] * term["history_length"]
        columns += range(stop - term["size"], stop)
    return obs[..., columns]


def _error(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Return the mean difference of the column that differs most, relative to the size of the recorded signal."""
    if not len(ours):
        return 0.0
    ours = ours.reshape(len(ours), -1)
    theirs = theirs.reshape(len(theirs), -1)
    # By the mean size of all columns: one that is zero would blow up its own relative error.
    size = np.abs(ours).mean() + 1e-6
    return float(np.abs(ours - theirs).mean(0).max() / size)


def _unlike(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Return the error that is left when each of our columns may be scaled and shifted."""
    ours = ours - ours.mean(0)
    theirs = theirs - theirs.mean(0)
    return _error(ours * _ratios(ours, theirs), theirs)


def _ratios(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Return the factor of each column, [L], by least squares; 1 where nothing moves."""
    power = (ours * ours).sum(0)
    # Columns that hardly move have no factor: it would be the quotient of two roundings.
    still = power < 1e-9 * max(float(power.max()), 1e-12)
    return np.where(still, 1.0, (ours * theirs).sum(0) / np.where(still, 1.0, power))


def _order(ours: np.ndarray, theirs: np.ndarray) -> list[int] | None:
    """Return the order of our columns in which they match theirs, or None if there is no other one that does."""
    if ours.shape[1] < 2:
        return None
    # [theirs, ours]: mean distance of each pair of columns.
    apart = np.abs(theirs[:, :, None] - ours[:, None, :]).mean(0)
    order = apart.argmin(1)
    # Columns that are equal, such as targets that are never written, keep their places.
    own = np.arange(len(order))
    order = np.where(apart[own, own] <= apart[own, order] + 1e-9, own, order)
    # A permutation, and not the identity: two of theirs that look like one of ours are no order.
    is_other = sorted(order) == list(own) and (order != own).any()
    matches = _error(ours[:, order], theirs) <= LIKE
    if is_other and matches:
        return order.tolist()
    return None


def _shift(
    ours: np.ndarray, theirs: np.ndarray, episode: np.ndarray, tolerance: float = LIKE
) -> int | None:
    """Return by how many steps theirs is late, negative where it is early; None where no shift explains it."""
    best = _error(ours, theirs)
    found = None
    # Small shifts first, so that a periodic signal does not match one period later.
    for shift in (s for k in range(1, MOST_SHIFT + 1) for s in (k, -k)):
        if shift > 0:
            late = slice(shift, None)
            early = slice(None, -shift)
        else:
            late = slice(None, shift)
            early = slice(-shift, None)
        # Rows of two episodes are not neighbours in time.
        whole = episode[late] == episode[early]
        error = _error(ours[early][whole], theirs[late][whole])
        # It has to fit well, and clearly better than the best so far.
        if whole.any() and error <= min(tolerance, 0.3 * best):
            best = error
            found = shift
    return found
