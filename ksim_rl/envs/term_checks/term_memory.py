"""The memory that terms reach through their view, piece by piece: its name, and who may write it."""

from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Shaped
from torch import Tensor
from torch.utils._pytree import tree_leaves

from ksim_rl.device.constants import constants
from ksim_rl.device.extents import extent
from ksim_rl.envs.view import EnvView, Readings
from ksim_rl.physics import views
from ksim_rl.scene.state.buffers import ENV
from ksim_rl.scene.state.quantity import QuantityOf
from ksim_rl.scene.state.simulation import Simulation

STATE = "state"
MOCAP = "mocap"
INPUT = "input"
COMPUTED = "computed"
"""Of the worlds: positions and velocities, poses of mocap bodies, other inputs of the physics, and its results."""
FIELD = "field"
MODEL = "model"
"""Model fields that differ between worlds, and fields of the model that all worlds share."""
PARAMETER = "parameter"
DIFFICULTY = "difficulty"
"""Tables and targets that events and actions write for all to read, and values that curricula write."""
TABLE = "table"
QUANTITY = "quantity"
"""Tensors that are never written once they are made, and quantities that were computed once for all readers."""

_KIND_OF_ARRAY = {"qpos": STATE, "qvel": STATE, "mocap_pos": MOCAP, "mocap_quat": MOCAP}
_KIND_OF_ARRAY |= (
    dict.fromkeys((*views.SUBSTEP_INPUTS, "eq_active", "userdata"), INPUT) | _KIND_OF_ARRAY
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Piece:
    """A piece of memory: its name as a term spells it, its owner, and where it lies (first byte, and the one behind).

    The owner is the scope of a term ("rewards/upright"), or one of the kinds above. `tensor` is None where a piece is
    known by its place alone; one that `has_rows` has a row per env.
    """

    name: str
    owner: str
    start: int
    end: int
    tensor: Tensor | None = None
    has_rows: bool = False

    @cached_property
    def bits(self) -> Shaped[Tensor, "*shape"] | None:
        """The bits of the tensor, as NaN equals no NaN, and 0 equals -0."""
        if self.tensor is None:
            return None
        return bits_of(self.tensor)


def bits_of(tensor: Shaped[Tensor, "*shape"]) -> Shaped[Tensor, "*shape"]:
    """Return the bits of numbers, on the same memory."""
    if not tensor.is_floating_point():
        return tensor
    whole_number = {2: torch.int16, 4: torch.int32, 8: torch.int64}
    return tensor.view(whole_number[tensor.element_size()])


def _piece(
    name: str, owner: str, tensor: Shaped[Tensor, "*shape"], *, has_rows: bool = False
) -> Piece:
    start, end = extent(tensor)
    return Piece(name=name, owner=owner, start=start, end=end, tensor=tensor, has_rows=has_rows)


class TermMemory:
    """Finds the piece of memory that a tensor lies in, and so its owner.

    Lasting pieces are listed again only when there are more of them, as while an env is constructed; quantities, which
    come and go with each state, are looked up when they are asked for.
    """

    def __init__(self, simulation: Simulation, readings: Readings, view: EnvView) -> None:
        self._simulation = simulation
        self._readings = readings
        self._view = view
        self._pieces: list[Piece] = []
        self._starts: list[int] = []
        self._listed_at: tuple[int, ...] = ()
        self._aliases = _aliases(view)

    def lasting(self) -> list[Piece]:
        """Return all lasting pieces, by address; no two overlap, except for columns of one table."""
        # Listing takes long, counting does not: nothing is removed, so equal counts mean the same pieces.
        counts = self._counts()
        if counts != self._listed_at:
            self._pieces = self._listed()
            self._starts = [piece.start for piece in self._pieces]
            self._listed_at = counts
        return self._pieces

    def quantities(self) -> list[Shaped[Tensor, "*?shape"]]:
        """Return the quantities that are computed now and are no windows onto lasting memory."""
        pieces = self.lasting()
        found: list[Tensor] = []
        # Windows onto lasting memory are compared there already.
        for cache in self._simulation.caches():
            for value in cache.values():
                for _, tensor in _leaves("", value):
                    if self._at(pieces, *extent(tensor)) is None:
                        found.append(tensor)
        return found

    def holder(self, tensor: Shaped[Tensor, "*shape"]) -> Piece | None:
        """Return the piece that a tensor lies in; None for memory that the view does not give."""
        if not tensor.numel() or tensor.layout is not torch.strided:
            return None
        start, end = extent(tensor)
        # A window onto lasting memory counts as that memory, though a quantity may name it, too.
        lasting = self._at(self.lasting(), start, end)
        if lasting is not None:
            return lasting
        # No lasting piece: any overlap with a quantity counts.
        for quantity in self._named_quantities():
            if quantity.start < end and start < quantity.end:
                return quantity
        return None

    def spelled(self, tensor: Shaped[Tensor, "*shape"], piece: Piece) -> str:
        """Return a term's name of a tensor that it has written: a quantity, even if it is a window onto the piece."""
        start, end = extent(tensor)
        around: list[Piece] = []
        for quantity in self._named_quantities():
            if quantity.tensor is tensor:
                return quantity.name
            if quantity.start <= start and end <= quantity.end:
                around.append(quantity)
        # Of several windows the narrowest says most.
        narrowest = min(around, key=lambda quantity: quantity.end - quantity.start, default=piece)
        return narrowest.name

    def _at(self, pieces: list[Piece], start: int, end: int) -> Piece | None:
        """Return the lasting piece that overlaps the bytes between two addresses."""
        # The last piece that begins before `end`; it overlaps if it ends behind `start`.
        place = bisect_left(self._starts, end) - 1
        if place >= 0 and pieces[place].end > start:
            return pieces[place]
        return None

    def _counts(self) -> tuple[int, ...]:
        """Return the number of entries of each kind that still grows while an env is constructed."""
        simulation = self._simulation
        readings = self._readings
        # Caches are left out, as quantities are looked up again each time.
        growing = (
            simulation.buffers.by_name(),
            simulation.shared_values.by_name(),
            simulation.world.views(),
            readings.reward_weights,
            readings.terminations,
            self._view.parts(),
            constants(),
        )
        return tuple(len(one) for one in growing)

    def _listed(self) -> list[Piece]:
        found = [
            *self._of_env(),
            *self._of_buffers(),
            *self._of_worlds(),
            *self._of_tables(),
        ]
        # The first name of a piece stays: a per-world field is called as in the view, not as in Warp's model.
        by_start: dict[int, Piece] = {}
        for piece in found:
            by_start.setdefault(piece.start, piece)
        return [by_start[start] for start in sorted(by_start)]

    def _of_env(self) -> Iterator[Piece]:
        """List the tensors that managers and curricula write."""
        readings = self._readings
        for name, weight in readings.reward_weights.items():
            yield _piece(f"view.reward_weights[{name!r}]", DIFFICULTY, weight)
        for name, flag_E in readings.terminations.items():
            yield _piece(f"view.terminations[{name!r}]", ENV, flag_E)

    def _of_buffers(self) -> Iterator[Piece]:
        # Buffers that terms know by an attribute of the view have that name, others the buffer's own.
        spelled = {id(tensor): f"view.{name}" for name, tensor in _tensors_of(self._view)}
        spelled |= {id(tensor): f"view.{name}" for name, tensor in _tensors_of(self._readings)}
        for name, value_EK in self._readings.commands.items():
            spelled[id(value_EK)] = f"view.command({name!r})"
        buffers = self._simulation.buffers
        shared = self._simulation.shared_values
        for name, buffer in buffers.by_name().items():
            if buffer.numel():
                called = spelled.get(id(buffer), f"the buffer {name!r}")
                yield _piece(called, buffers.owner(name) or PARAMETER, buffer, has_rows=True)
        for name, value in shared.by_name().items():
            called = spelled.get(id(value), f"the shared value {name!r}")
            yield _piece(called, shared.owner(name) or DIFFICULTY, value)

    def _of_worlds(self) -> Iterator[Piece]:
        world = self._simulation.world
        for name, field in world.per_world_fields().items():
            if field.numel():
                yield _piece(f"view.field({name!r})", FIELD, field, has_rows=True)
        # Arrays of Warp by the ways in which a term can reach them.
        shown = {name: f"view.world.view({name!r})" for name in views.READABLE}
        # "qpos_EL" is the view of the array "qpos".
        for attribute in views.DataViews.__annotations__:
            shown[attribute.rpartition("_")[0]] = f"view.world.{attribute}"
        for called, tensor, start, end in world.memory():
            # The part before the last dot says whether the array is of the model or of the worlds.
            room, _, name = called.rpartition(".")
            if room.endswith("model"):
                owner = MODEL
            else:
                owner = _KIND_OF_ARRAY.get(name, COMPUTED)
            if owner == MODEL:
                spelled = called
            else:
                spelled = shown.get(name, called)
            # Arrays without a view are known by their addresses only.
            if tensor is None:
                yield Piece(name=spelled, owner=owner, start=start, end=end)
            else:
                has_rows = tensor.ndim > 0 and tensor.shape[0] == world.num_envs
                yield _piece(spelled, owner, tensor, has_rows=has_rows)

    def _of_tables(self) -> Iterator[Piece]:
        """List the tensors of the view's parts that nothing above has named: clocks, limits, poses, indices."""
        for spelled, part in self._view.parts().items():
            for name, tensor in _tensors_of(part):
                yield _piece(f"{spelled}.{name}", TABLE, tensor)
        # Shared by all terms of the process, so no term may write them.
        for tensor in constants():
            if tensor.numel():
                start, end = extent(tensor)
                yield Piece(
                    name="a constant that all terms share", owner=TABLE, start=start, end=end
                )

    def _named_quantities(self) -> Iterator[Piece]:
        """List all quantities, windows too, as terms call them."""
        # The part of the view whose cache has the quantity, as in `view.robot.`.
        owners = {
            id(vars(part).get("cache")): spelled for spelled, part in self._view.parts().items()
        }
        for cache in self._simulation.caches():
            for key, value in cache.items():
                # Of elements that a robot reads for itself, as of its root body, no term knows how to spell them.
                spelled = owners.get(id(cache), "a computed")
                called = self._aliases.get((id(cache), key))
                if called is None:
                    is_named = spelled != "view" or hasattr(type(self._view), key)
                    if is_named:
                        called = f"{spelled}.{key}"
                    else:
                        called = f"view.cache[{key!r}]"
                for name, tensor in _leaves(called, value):
                    yield _piece(name, QUANTITY, tensor)
        for name, sum_E in self._readings.episode_rewards.items():
            yield _piece(f"view.episode_rewards[{name!r}]", QUANTITY, sum_E)


def _aliases(view: EnvView) -> dict[tuple[int, str], str]:
    """Return the view's own names of quantities that are its parts', by cache and key."""
    aliases: dict[tuple[int, str], str] = {}
    for base in type(view).__mro__:
        for name, attribute in vars(base).items():
            if isinstance(attribute, QuantityOf):
                cache = getattr(view, attribute.part).cache
                aliases[id(cache), attribute.cached_as] = f"view.{name}"
    return aliases


def _tensors_of(part: object) -> Iterator[tuple[str, Tensor]]:
    """Return the tensors that are attributes of an object, tables of tensors included, with their names in terms."""
    for name, value in vars(part).items():
        if name == "cache":
            continue
        # `_origins_E3` is read as `origins_E3`.
        yield from _leaves(name.lstrip("_"), value)


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Tensor]]:
    """Return the tensors of a value: itself, the fields of a named tuple, or the items of a tuple or list."""
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        for field, part in value._asdict().items():  # pyright: ignore[reportAttributeAccessIssue]
            yield from _leaves(f"{name}.{field}", part)
    elif isinstance(value, Tensor):
        if value.numel():
            yield name, value
    elif isinstance(value, (tuple, list)):
        for leaf in tree_leaves(value):
            if isinstance(leaf, Tensor) and leaf.numel():
                yield name, leaf
