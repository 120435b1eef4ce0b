"""The kinds of term that an env is made of: small frozen dataclasses that read an `EnvView`.

A term's parameters are its fields, so that the same object is written in Python and as a Hydra `_target_`. Terms hold
no tensors: names are resolved through the view, which remembers them, and the state that a term keeps from step to step
is a named buffer of the view (`view.buffer`), which advances once per env step. A term must not branch on tensor
values, read a tensor on the host or allocate sizes that depend on data: the step that calls it is captured into a CUDA
graph. It writes no tensor that the view gives it: `term_rules` says what each kind may write, and `term_guard` refuses
the rest.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from ksim_rl.checked import Checked, NonNegativeRange, Within
from ksim_rl.envs.view import EnvView
from ksim_rl.scene.rendering.visualizer import DebugVisualizer

Fields = Mapping[str, bool | float | str | tuple[float, ...]]
"""Values of some fields of a term."""
CommandRanges = Mapping[str, tuple[float, float]]
"""Ranges that a command is drawn from, (low, high) by field."""

EventMode = Literal["startup", "reset", "start", "interval", "step"]
"""When an event happens: as the env is made, at a reset, at an episode's start, after drawn times, at each step."""
Reduction = Literal["mean", "last", "max", "sum"]
"""How an episode reduces the values of a metric to one."""


@dataclass(frozen=True, kw_only=True)
class Term(Checked, ABC):
    """The base of all kinds of term; kinds may share fields (see `ksim_rl.mdp.fields`)."""


@dataclass(frozen=True, kw_only=True)
class ObservationTerm(Term):
    """A clean reading: float32 [E, L]. Noise, delay and history are transforms, not part of the term.

    A term with `is_image` gives float32, int32 or uint8 of shape [E, H, W] or [E, H, W, C] instead, and stands alone in
    its observation group, whose value is then the image itself.
    """

    is_image: ClassVar[bool] = False

    @abstractmethod
    def __call__(self, view: EnvView) -> Shaped[Tensor, " E *leaf"]:
        """Return the reading of the current state."""


@dataclass(frozen=True, kw_only=True)
class RewardTerm(Term):
    """A reward per second (or per step, if the env does not scale by dt), before its weight; 0 is not computed."""

    # Losses have squares of returns, which would overflow float32: every gradient step would be skipped.
    weight: Annotated[float, Within(low=-1e12, high=1e12)] = 1.0

    @abstractmethod
    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        """Return the unweighted reward of the current state, float32 [E]."""

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw the quantities that the reward of one env depends on (nothing by default)."""


@dataclass(frozen=True, kw_only=True)
class TerminationTerm(Term):
    """A condition that ends the episode; `time_out` marks it as a truncation."""

    time_out: bool = False

    @abstractmethod
    def __call__(self, view: EnvView) -> Bool[Tensor, " E"]:
        """Return which envs end, bool [E]."""


@dataclass(frozen=True, kw_only=True)
class MetricTerm(Term):
    """A value per step that is reduced over the episode and reported when it ends.

    With `per_substep` it is the mean over the physics substeps of the env step. There the state, efforts and contact
    sensors with `every_substep` are current; what has to be derived, such as poses of bodies, is refused.
    """

    reduce: Reduction = "mean"
    per_substep: bool = False

    @abstractmethod
    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        """Return the value of the current state, float32 [E]."""


@dataclass(frozen=True, kw_only=True)
class EventTerm(Term):
    """A write to the simulation: `startup` once, `reset` for rows that reset, `interval` by per-env clocks, `step`.

    `start` is for rows that reset, too, once all is set for their episode, commands included, which these events may
    read; it costs a second refresh of these rows.

    An event must not read a derived quantity (a body or site pose, a sensor) after state was written, as it is before
    all reset events: derived quantities are refreshed after all events of the moment have run.
    """

    mode: EventMode = "reset"
    interval_range_s: NonNegativeRange | None = None

    def _check_fields(self) -> None:
        super()._check_fields()
        if (self.mode == "interval") != (self.interval_range_s is not None):
            raise ValueError(
                f"interval_range_s={self.interval_range_s!r} with mode={self.mode!r}: give a pair of seconds with "
                "mode='interval', and None with any other"
            )

    @property
    def per_world_fields(self) -> tuple[str, ...]:
        """The MuJoCo model fields that this event writes, which therefore become one array per world."""
        return ()

    def without_effect(self, view: EnvView) -> Sequence[str]:
        """Return a line for each field that this event writes without effect in this model; a build warns."""
        return ()

    def check_beside(self, view: EnvView, events: Mapping[str, "EventTerm"]) -> None:
        """Refuse, by a ValueError, events of the same env that would undo what this one writes, or the other way round.

        `events` has them all by name, in the order in which they run; this one is among them.
        """

    @abstractmethod
    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        """Apply the event to the rows of `mask_E`, bool [E]; other rows must stay bit-identical."""


@dataclass(frozen=True, kw_only=True)
class CommandTerm(Term):
    """A generator of commands with a per-env clock that resamples; None as its range draws at resets only."""

    resampling_time_range_s: NonNegativeRange | None
    drawn: ClassVar[tuple[str, ...]] = ()  # the fields with the ranges

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        """The ranges by field that `resample` draws from and that a curriculum may change: see `shared_ranges`."""
        return {name: getattr(self, name) for name in self.drawn}

    def shared_ranges(self, view: EnvView) -> Float[Tensor, "2 N"]:
        """Return the present ranges, (low, high) [2, N] in the order of `ranges`; they start at those."""
        return view.shared("ranges_2N", tuple(zip(*self.ranges.values(), strict=True)))

    def bounds(self, view: EnvView, ranges: CommandRanges) -> Sequence[tuple[float, float]] | None:
        """Return the bounds of each column, (low, high), if it is drawn from `ranges`; None where they are unknown.

        A robot that runs the policy is kept from commands beyond.
        """
        return None

    @abstractmethod
    def resample(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        """Draw new targets for the rows of `mask_E`, bool [E], into `view.buffer` buffers."""

    @abstractmethod
    def __call__(self, view: EnvView) -> Float[Tensor, "E K"]:
        """Return the command of the current state and targets, float32 [E, K]."""

    def set(
        self, view: EnvView, value_EK: Float[Tensor, "*rows K"], mask_E: Bool[Tensor, " E"]
    ) -> None:
        """Take values from outside for the rows of `mask_E`; a ValueError if this kind of command is drawn instead."""
        raise ValueError(
            f"a {type(self).__name__} draws its values; a JoystickCommand takes them from outside"
        )

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw the command of one env (nothing by default)."""


@dataclass(frozen=True, kw_only=True)
class ActionTerm(Term):
    """A map from some columns of the action to the controls of actuators."""

    @abstractmethod
    def size(self, view: EnvView) -> int:
        """Return how many columns of the action this term takes."""

    def bounds(self, view: EnvView) -> Float[Tensor, "K 2"] | None:
        """Return the range, (low, high) [K, 2], outside of which a column does nothing more; None has no such range."""
        return None

    @abstractmethod
    def __call__(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> None:
        """Write the controls that `action_EK` (this term's columns, finite) asks for, for the whole env step."""


@dataclass(frozen=True, kw_only=True)
class CurriculumTerm(Term):
    """A rule that adapts difficulty; it runs for the rows that reset, before the reset events.

    It may write `view.reward_weights[name]`, a tensor [] per reward term, for the rewards that it names in
    `adapted_rewards`: those are computed even while their weight is 0. It may write
    `view.command_ranges[command][field]`, (low, high) [2], and one curriculum may write `view.level`. Rows of
    `mask_E` with `view.episode_step_E == 0` have not lived; where `mask_E` is empty, nothing may change.
    """

    @property
    def adapted_rewards(self) -> tuple[str, ...]:
        """The reward terms whose weights this curriculum changes."""
        return ()

    @property
    def adapted_fields(self) -> Mapping[str, Sequence[Fields]]:
        """Other values of fields, stage by stage, by the term that has them, such as "rewards/upright".

        The term is built and computed for each stage, and `view.stages` says which one's value holds: 0 for the term
        as the config has it, 1 for the first of these.
        """
        return {}

    def command_ranges(self, step_count: int) -> Mapping[str, Sequence[CommandRanges]]:
        """Return the other ranges that this curriculum may have given until an env step, by command."""
        return {}

    @property
    def first_level(self) -> float | None:
        """The first `view.level`, if this curriculum drives it; else None."""
        return None

    @abstractmethod
    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> Float[Tensor, ""]:
        """Adapt and return the level to report, float32 []; its state lives in `view.buffer(..., keep=True)`."""


def hull(ranges: Iterable[tuple[float, float]]) -> tuple[float, float]:
    """Return the narrowest range, (low, high), that holds all of some."""
    lows, highs = zip(*ranges, strict=True)
    return min(lows), max(highs)
