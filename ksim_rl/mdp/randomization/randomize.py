"""Domain randomization makes each world's model differ; this is the base of its events.

Each draw starts from the model's own values, so that neither the order of resets nor their number matters.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal, Self, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import NonNegative, Positive, Range, Within, check_value
from ksim_rl.checks import check_choice
from ksim_rl.envs.term import EventMode, EventTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant, index_constant, values_by_name
from ksim_rl.mdp.randomization.drawing import draw_entries
from ksim_rl.scene.names import Patterns

Pair = tuple[float, float]
Operation = Literal["abs", "add", "scale"]
Distribution = Literal["uniform", "log_uniform", "gaussian"]
_RANGES: Mapping[str, Any] = {
    "uniform": Range,
    "log_uniform": Annotated[tuple[Positive, Positive], Within(ordered=True)],
    "gaussian": tuple[float, NonNegative],
}
# Where a gaussian draw is cut, in standard deviations, so that its reach can be checked.
CUT = 3.0
_KINDS = {"cam": "camera", "mat": "material", **dict.fromkeys(("jnt", "dof", "qpos0"), "joint")}


@dataclass(frozen=True, kw_only=True)
class Randomize(EventTerm):
    """Draw values per world: once at startup, for the rows that reset, or at intervals.

    Attributes:
        operation: "abs" replaces the model's own value, "add" and "scale" start from it, not from the last draw.
        distribution: "uniform" and "log_uniform" draw between the numbers (low, high) of a range; log_uniform needs
            positive ones. "gaussian" takes the pair as (mean, standard deviation), and is cut at three of these.
        shared: one draw for all elements of a world, instead of one for each.
    """

    mode: EventMode = "startup"
    operation: Operation = "abs"
    distribution: Distribution = "uniform"
    shared: bool = False

    drawn: ClassVar[tuple[str, ...]] = ()  # the fields with one range each, or None

    def _check_fields(self) -> None:
        super()._check_fields()
        for name in self.drawn:
            # None means that this quantity is not drawn.
            if getattr(self, name) is not None:
                self.check_range(name, getattr(self, name))

    def check_range(self, name: str, pair: object) -> None:
        """Raise a ValueError for a range that the distribution cannot draw from."""
        check_value(f"{name} ({self.distribution})", pair, _RANGES[self.distribution])

    def draw(self, view: EnvView, count: int, pairs: Sequence[Pair]) -> Float[Tensor, "E N C"]:
        """Draw `count` rows per world, or one if shared, with one column per range."""
        # Zeros as own values, with the operation "abs": the kernel gives the plain draws.
        own_NC = np.zeros((1 if self.shared else count, len(pairs)))
        drawn_ENC = torch.empty(view.num_envs, *own_NC.shape, device=view.device)
        # Columns are numbered from 0: the target is a table of its own.
        self._draw_into(drawn_ENC, view, own_NC, range(len(own_NC)), dict(enumerate(pairs)))
        return drawn_ENC

    def _draw_into(
        self, field_ENC: Tensor, view: EnvView, own_NC: np.ndarray, ids: Sequence[int], pairs: Mapping[int, Pair],
        operation: Operation = "abs", mask_E: Tensor | None = None,
        follower: tuple[Tensor | None, Sequence[float]] = (None, ()),
    ) -> None:  # fmt: skip
        # The kernel reads floats from one table: both ends, then columns, rows, own values, and the
        # follower's ratios.
        low, high = zip(*pairs.values(), strict=True)
        _, ratios = follower
        numbers_of_table = (*low, *high, *pairs, *ids, *own_NC.flat, *ratios)
        table_L = constant(numbers_of_table, view.device)
        # The kernel knows kinds and operations by their places in the literals.
        kinds = (
            get_args(Distribution).index(self.distribution),
            get_args(Operation).index(operation),
        )
        numbers = [*own_NC.shape, int(self.shared), *kinds]
        # Keys of seed, stream and counter make draws the same whichever rows reset together.
        keys = view.next_keys()
        given = (
            keys.seed,
            keys.counter,
            table_L,
            follower[0],
            numbers,
            CUT,
            keys.stream,
            keys.first_row,
        )
        draw_entries(field_ENC, mask_E, *given)

    def combine(
        self, nominal: Float[Tensor, "*own"], drawn: Float[Tensor, "*draws"]
    ) -> Float[Tensor, "*values"]:
        """Return the values that the draws make of the model's own; these broadcast to the draws."""
        if self.operation == "abs":
            return drawn
        if self.operation == "add":
            return nominal + drawn
        return nominal * drawn

    def reach(self, nominal: np.ndarray, pair: Pair) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest values that the draws can make of the model's own, shaped like these."""
        low, high = pair
        # The cut makes even a gaussian's reach finite.
        if self.distribution == "gaussian":
            mean, deviation = pair
            low = mean - CUT * deviation
            high = mean + CUT * deviation
        if self.operation == "add":
            return nominal + low, nominal + high
        # A negative own value swaps the ends.
        if self.operation == "scale":
            return np.minimum(nominal * low, nominal * high), np.maximum(
                nominal * low, nominal * high
            )
        return np.full_like(nominal, low), np.full_like(nominal, high)


@dataclass(frozen=True, kw_only=True)
class RandomizeNumber(Randomize):
    """Draw one number per element and world from `ranges`."""

    drawn = ("ranges",)

    ranges: Pair


@dataclass(frozen=True, kw_only=True)
class RandomizeField(Randomize):
    """Draw a model field per world, whose rows are elements of one kind: a subclass names its `bodies`, `geoms` ..."""

    field: ClassVar[str]
    columns: ClassVar[int] = 1

    @property
    def kind(self) -> str:
        """The kind of element, as `NameResolver` calls it."""
        # Fields are named "<kind>_<quantity>", but for some kinds that MuJoCo abbreviates.
        prefix = self.field.split("_")[0]
        return _KINDS.get(prefix, prefix)

    @property
    def elements_field(self) -> str:
        """The name of the subclass's field of patterns, in the plural."""
        return {"body": "bodies"}.get(self.kind, f"{self.kind}s")

    @property
    def elements(self) -> Patterns:
        """Names or patterns of the elements that are randomized."""
        return getattr(self, self.elements_field)

    @property
    def per_world_fields(self) -> tuple[str, ...]:
        return (self.field,)

    def ids(self, view: EnvView) -> tuple[int, ...]:
        """Return the rows of the field that are meant."""
        return view.resolver.ids(self.kind, self.elements)

    def nominal(self, view: EnvView) -> np.ndarray:
        """Return the model's own values of the rows that are meant, [N, columns]."""
        values = np.asarray(getattr(view.world.mj_model, self.field), dtype=np.float64)
        # Fields with one number per row are [N] in the model; [N, 1] here.
        return values.reshape(-1, self.columns)[list(self.ids(view))]


@dataclass(frozen=True, kw_only=True)
class RandomizeModelField(RandomizeField):
    """Draw entries of a model field per world from `ranges`, by its columns, or one pair for every column.

    Where columns mean different things, `columns_of_one_pair` are those that one pair is for. Ranges may also be by
    names of elements, regular expressions of which each element matches one: `{".*_hip": (0.1, 0.2), ".*_knee": ...}`.
    """

    ranges: Pair | Mapping[int | str, Pair]

    lowest: ClassVar[float | None] = None  # the least value that makes sense
    highest: ClassVar[float | None] = None  # and at most
    columns_of_one_pair: ClassVar[tuple[int, ...]] = ()

    def _check_fields(self) -> None:
        super()._check_fields()
        if not isinstance(self.ranges, Mapping):
            self.check_range("ranges", self.ranges)
            return
        if len({type(key) for key in self.ranges}) > 1:
            raise ValueError(f"ranges={self.ranges!r}: keys are either columns or names, not both")
        for key, pair in self.ranges.items():
            if not isinstance(key, str):
                check_choice("ranges", key, range(self.columns))
            elif not hasattr(self, self.elements_field):
                raise ValueError(
                    f"ranges has the key {key!r}: there are no elements to name; use columns, 0 and on"
                )
            self.check_range(f"ranges[{key}]", pair)

    def by_name(self, view: EnvView) -> list[Self]:
        """Return an event for each pattern of `ranges`, with the elements that match it; this one without patterns."""
        if not isinstance(self.ranges, Mapping):
            return [self]
        pairs = {pattern: pair for pattern, pair in self.ranges.items() if isinstance(pattern, str)}
        if not pairs:
            return [self]
        names = view.resolver.names(self.kind)
        chosen = [names[i] for i in view.resolver.ids(self.kind, self.elements)]
        # Which pattern each element matches: exactly one.
        number_of = values_by_name(
            "ranges", {pattern: n for n, pattern in enumerate(pairs)}, chosen
        )
        events = []
        for number, pair in enumerate(pairs.values()):
            own = [
                re.escape(name)
                for name, found in zip(chosen, number_of, strict=True)
                if found == number
            ]
            events.append(replace(self, **{self.elements_field: tuple(own), "ranges": pair}))
        return events

    def ranges_by_column(self) -> dict[int, Pair]:
        """Return the ranges by column, in the order of the columns."""
        if isinstance(self.ranges, Mapping):
            # Ranges by name have become events of one range each: see `by_name`.
            return {int(column): pair for column, pair in sorted(self.ranges.items())}
        return dict.fromkeys(self.columns_of_one_pair or range(self.columns), self.ranges)

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        for event in self.by_name(view):
            event.draw_columns(view, mask_E)

    def without_effect(self, view: EnvView) -> Sequence[str]:
        return [line for event in self.by_name(view) for line in event.unfelt_columns(view)]

    def unfelt_columns(self, view: EnvView) -> Sequence[str]:
        """Return the lines of `without_effect` for ranges that are not by name."""
        return ()

    def draw_columns(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        """Draw the entries of ranges that are not by name, in the rows of `mask_E`."""
        ids = self.ids(view)
        pairs = self.ranges_by_column()
        nominal = self.nominal(view)
        if not pairs:
            return
        self._check_reach(view, nominal, pairs)
        # Fields [E, rows] and [E, rows, columns] alike as [E, rows, columns].
        field_ENC = view.field(self.field).view(view.num_envs, -1, self.columns)
        own_NC = nominal[:, list(pairs)]
        follower = self._follower(view)
        self._draw_into(field_ENC, view, own_NC, ids, pairs, self.operation, mask_E, follower)

    def _follower(self, view: EnvView) -> tuple[Tensor | None, Sequence[float]]:
        """Return, if there is one, the field that grows in proportion to this one, and how much, [N * columns]."""
        return None, ()

    def _check_reach(self, view: EnvView, nominal: np.ndarray, pairs: Mapping[int, Pair]) -> None:
        # Both ends of each column against the bounds; the worst element is named.
        for column, pair in pairs.items():
            low, high = self.reach(nominal[:, column], pair)
            for values, place, bound, beyond, word in (
                (low, low.argmin(), self.lowest, -1.0, "least"),
                (high, high.argmax(), self.highest, 1.0, "most"),
            ):
                if bound is not None and (values[place] - bound) * beyond > 0.0:
                    # Rows are ids; the resolver gives their names.
                    rows = view.resolver.ids(self.kind, self.elements)
                    name = view.resolver.names(self.kind)[rows[int(place)]]
                    raise ValueError(
                        f"{type(self).__name__}.ranges={self.ranges!r}: {self.field} of {self.kind} {name!r} would "
                        f"reach {values[place]:g}; expected at {word} {bound:g}"
                    )


def write_entries(
    field_E: Float[Tensor, " E *field"],
    ids: Sequence[int],
    columns: Sequence[int],
    mask_E: Bool[Tensor, " E"],
    value_ENC: Float[Tensor, "E N C"],
) -> None:
    """Write entries of a per-world field, [E, rows] or [E, rows, columns], in the worlds of `mask_E`."""
    if field_E.ndim == 2:
        entries_ERC = field_E.unsqueeze(-1)
    else:
        entries_ERC = field_E
    rows = index_constant(ids, field_E.device)
    across = index_constant(columns, field_E.device)
    # A gather copies unless both are slices, which give a view to write into.
    held_ENC = entries_ERC[:, rows][..., across]
    if isinstance(rows, slice) and isinstance(across, slice):
        torch.where(mask_E[:, None, None], value_ENC, held_ENC, out=held_ENC)
        return
    # Two index tensors are paired elementwise; a column of rows makes them an outer product.
    if isinstance(rows, Tensor) and isinstance(across, Tensor):
        rows = rows[:, None]
    entries_ERC[:, rows, across] = torch.where(mask_E[:, None, None], value_ENC, held_ENC)
