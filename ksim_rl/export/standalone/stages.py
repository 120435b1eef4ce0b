"""The stages of readings and actions: clips, scales, filters, joint targets."""

from collections.abc import Callable

import numpy as np

from ksim_rl.export.standalone.description import (
    ClipStage,
    JointActionSpec,
    LowPassStage,
    ScaleStage,
    ShapeSpec,
    TermSpec,
)
from ksim_rl.export.standalone.files import Array

Stage = Callable[[Array], Array]


def clipped_and_scaled(spec: TermSpec) -> Stage:
    """Return the processing of an observation term's raw values, without noise and delay."""
    low, high = spec["clip"]
    # JSON has no infinity: None is a side without a bound.
    low = -np.inf if low is None else low
    high = np.inf if high is None else high
    scale = np.asarray(spec["scale"])
    return lambda value: np.clip(value, low, high) * scale


class LowPass:
    """A first-order filter over env steps; where `initial` is None it starts at the first value of an episode."""

    def __init__(self, alpha: float, initial: float | None) -> None:
        self.alpha = alpha
        self.initial = initial
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self.kept: Array | float | None = self.initial

    def __call__(self, value: Array) -> Array:
        """Return the filtered value of this env step."""
        before = value if self.kept is None else self.kept
        filtered = before + self.alpha * (value - before)
        self.kept = filtered
        return filtered


def stage(spec: LowPassStage | ClipStage | ScaleStage, resets: list[Callable[[], None]]) -> Stage:
    """Return a stage of `action_chain` other than a delay; a stage with memory adds its reset to `resets`."""
    if spec["kind"] == "clip":
        return lambda action: np.clip(action, spec["low"], spec["high"])
    if spec["kind"] == "scale":
        return lambda action: action * np.asarray(spec["scale"]) + np.asarray(spec["offset"])
    low_pass = LowPass(spec["alpha"], spec["initial"])
    resets.append(low_pass.reset)
    return low_pass


def shaping(spec: ShapeSpec, resets: list[Callable[[], None]]) -> Stage:
    """Return the function from an action's columns to targets: clip, tanh, scale, filter and offset, in this order."""
    low, high = spec["clip"] or (-np.inf, np.inf)
    scale = np.asarray(spec["scale"])
    offset = np.asarray(spec["offset"])
    low_pass = None
    if spec["alpha"] is not None:
        # Here the filtered value is the scaled action, and begins at 0 in each episode.
        low_pass = LowPass(spec["alpha"], 0.0)
        resets.append(low_pass.reset)

    def shaped(action: Array) -> Array:
        action = np.clip(action, low, high)
        if spec["tanh"]:
            action = np.tanh(action)
        action = action * scale
        if low_pass is not None:
            action = low_pass(action)
        return action + offset

    return shaped


class JointAction:
    """Columns of an action that are targets of joints, by kind: "pos", "vel" or "effort"."""

    def __init__(self, spec: JointActionSpec, resets: list[Callable[[], None]]) -> None:
        self.spec = spec
        self.names = spec["names"]
        self.columns = slice(*spec["columns"])
        self.shape = shaping(spec, resets)
        # Some actions give a velocity target too: then the first half of the columns is position.
        self.second = None
        velocity = spec.get("velocity")
        if velocity:
            self.second = shaping(velocity, resets)

    def __call__(self, action: Array, encoders: Array, shift: Array) -> dict[str, Array]:
        """Return the targets of `names` by kind.

        `encoders` are their readings, and `shift` is by how much their default pose differs from the model's own.
        """
        spec = self.spec
        given = action[self.columns]
        targets = {}
        if self.second is not None:
            given, velocity = np.split(given, 2)
            targets["vel"] = self.second(velocity)
        value = self.shape(given)
        if spec["relative"]:
            value = value + encoders
        # The offset has the model's own pose in it.
        if spec["from_default"]:
            value = value + shift
        low, high = spec["limits"]
        targets[spec["kind"]] = np.clip(value, low, high)
        return targets
