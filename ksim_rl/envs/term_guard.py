"""Refuses terms that write what is not theirs, by name: a reward that moves the robot, say, or changes a command."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Shaped
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from ksim_rl.device import recording
from ksim_rl.envs.term_memory import (
    DIFFICULTY,
    FIELD,
    INPUT,
    MOCAP,
    PARAMETER,
    STATE,
    Piece,
    TermMemory,
)
from ksim_rl.envs.view import EnvView, Readings
from ksim_rl.scene.state.buffers import Kept
from ksim_rl.scene.state.simulation import UNWATCHED, Simulation

_READS = "only reads what the view gives it, and keeps what it must in `view.buffer`"


@dataclass(frozen=True, kw_only=True)
class Rule:
    """What a kind of term is called, and what it may write beside its own buffers: owners of `Piece`.

    `State` is written by `view.write_qpos` and its like only, which know the rows and what becomes stale.
    """

    noun: str
    may: str
    writes: frozenset[str] = frozenset()


_MOVES = frozenset((STATE, MOCAP, INPUT, PARAMETER))
RULES = {
    "observations": Rule(noun="an observation", may=_READS),
    "rewards": Rule(noun="a reward", may=_READS),
    "terminations": Rule(noun="a termination", may=_READS),
    "metrics": Rule(noun="a metric", may=_READS),
    "actuators": Rule(noun="the law of an actuator", may="only reads state and targets, and returns the control"),
    "commands": Rule(
        noun="a command",
        may="only reads what the view gives it, keeps what it must in `view.buffer`, and may move mocap bodies",
        writes=frozenset((MOCAP,)),
    ),
    "sensors": Rule(
        noun="a sensor", may="only reads the worlds, and keeps what it must in buffers", writes=frozenset((PARAMETER,))
    ),
    "actions": Rule(
        noun="an action", may="writes targets, controls and other inputs of the worlds", writes=_MOVES
    ),
    "events": Rule(
        noun="an event",
        may="writes state, inputs and model fields of the worlds, in the rows of its mask",
        writes=_MOVES | {FIELD},
    ),
    "curriculum": Rule(
        noun="a curriculum",
        may="writes difficulty: `view.level`, reward weights, ranges of commands, terrain levels",
        writes=frozenset((DIFFICULTY, FIELD, PARAMETER)),
    ),
}
"""By the kind of a scope: "rewards" of "rewards/upright"."""


class _Writes(TorchDispatchMode):
    """Shows each tensor to `look` before an operator writes it, with the operator's name.

    Whatever way led to the tensor (a slice, `.data`, `detach`, `out=`, TorchScript), it comes by here.
    """

    def __init__(self, look: Callable[[str, Tensor], None]) -> None:
        super().__init__()
        self._look = look

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        for tensor in recording.written_by(func, args, kwargs):
            self._look(func.overloadpacket.__name__, tensor)
        return func(*args, **kwargs)


class _Call(NamedTuple):
    """One call of a term that is watched."""

    scope: str
    part: object
    mask_E: Tensor | None
    written: dict[str, Kept]

    @property
    def rule(self) -> Rule:
        return RULES[self.scope.partition("/")[0]]

    def owns(self, piece: Piece) -> bool:
        return piece.owner == self.scope

    def may_write(self, piece: Piece) -> bool:
        """Whether this term may write a piece by whatever means it likes, or by the view's."""
        # The ranges that a command draws from are shared with the curriculum that widens them.
        is_range = piece.owner.startswith("commands/") and not piece.has_rows
        adapts = is_range and DIFFICULTY in self.rule.writes
        return self.owns(piece) or piece.owner in self.rule.writes or adapts


class TermGuard:
    """Watches what terms write, where that costs nothing that counts, and refuses what is not theirs by a ValueError.

    Torch's writes are refused before they happen: at a term's first call, while a step is recorded or captured, and in
    the block of `watching`. Writes past torch (NumPy, Warp) show in the bits of what lasts, which are compared while a
    step is recorded and in the block of `watching`. Any other call costs one look-up.
    """

    def __init__(self, simulation: Simulation, readings: Readings, view: EnvView) -> None:
        self._simulation, self._view = simulation, view
        self._memory = TermMemory(simulation, readings, view)
        self._on_cuda = torch.device(simulation.device).type == "cuda"
        self._seen: set[tuple[str, int]] = set()
        self._is_on = self._compares = self._rehearses = False

    @contextmanager
    def watching(self, *, past_torch: bool = True) -> Iterator[None]:
        """Watch each call in this block, `past_torch` too, which makes the host wait for the device."""
        before = self._is_on, self._compares
        self._is_on, self._compares = True, past_torch
        try:
            yield
        finally:
            self._is_on, self._compares = before

    def watch(
        self, scope: str, part: object, mask_E: Bool[Tensor, " E"] | None
    ) -> AbstractContextManager[Mapping[str, Kept]]:
        """Return the watch of one call of `part`, which gives what it has written of its own; None is not watched."""
        if part is None:
            return UNWATCHED
        key = scope, id(part)
        is_captured = self._on_cuda and torch.cuda.is_current_stream_capturing()
        is_recorded = recording.is_recording()
        if key in self._seen and not (self._is_on or is_recorded or is_captured):
            return UNWATCHED
        self._seen.add(key)
        call = _Call(scope, part, mask_E, {})
        return self._watched(call, compares=(self._compares or is_recorded) and not is_captured)

    @contextmanager
    def _watched(self, call: _Call, *, compares: bool) -> Iterator[Mapping[str, Kept]]:
        before = self._copied() if compares else []
        refusals: list[ValueError] = []

        def look(operator: str, tensor: Tensor) -> None:
            refusal = self._look(call, operator, tensor)
            if refusal is not None:
                refusals.append(refusal)
                raise refusal

        try:
            with _Writes(look):
                yield call.written
        except Exception as error:
            # TorchScript makes an error of its own of it, which says nothing.
            if refusals and error is not refusals[0]:
                raise refusals[0] from error
            raise
        if refusals:
            # The term itself has caught it.
            raise refusals[0]
        if compares:
            self._compare(call, before)

    # -- by torch ------------------------------------------------------------------------------------------------

    def _look(self, call: _Call, operator: str, tensor: Tensor) -> ValueError | None:
        """Return what is wrong with a write, if anything is."""
        piece = self._memory.holder(tensor)
        if piece is None:
            return None
        is_state = piece.owner == STATE
        if call.may_write(piece) and (self._simulation.is_writing or not is_state):
            self._keep(call, piece)
            return None
        name = self._memory.spelled(tensor, piece)
        by_view = is_state and call.may_write(piece)
        how = f"writes into {name} in place (`{operator}`)"
        return ValueError(_refusal(call, how, name, piece, by_view=by_view))

    def _keep(self, call: _Call, piece: Piece) -> None:
        """Remember what a term writes that must advance once per env step."""
        is_own = call.owns(piece) or piece.owner == MOCAP
        if is_own and piece.tensor is not None:
            call.written[piece.name] = Kept(piece.tensor, piece.has_rows)

    # -- past torch ----------------------------------------------------------------------------------------------

    def _copied(self) -> list[tuple[Piece, Tensor]]:
        pieces = [*self._memory.lasting(), *self._memory.quantities()]
        with recording.paused():
            return [(piece, piece.tensor.clone()) for piece in pieces if piece.tensor is not None]

    def _compare(self, call: _Call, before: list[tuple[Piece, Tensor]]) -> None:
        """Refuse what has changed and is not the term's, or not in its rows."""
        with recording.paused():
            for piece, old in before:
                assert piece.tensor is not None
                new_bits, old_bits = _bits(piece.tensor), _bits(old)
                if torch.equal(new_bits, old_bits):
                    continue
                if not call.may_write(piece):
                    how = f"changes {piece.name} past torch (by NumPy, Warp or an address)"
                    raise ValueError(_refusal(call, how, piece.name, piece))
                self._keep(call, piece)
                if self._leaves_its_rows(call, piece, new_bits, old_bits):
                    raise ValueError(
                        f"{type(call.part).__name__} changes {piece.name} in rows outside of its mask: write "
                        "`torch.where(mask, new, old)`, or through `view.write_*(mask_E, ...)`"
                    )

    def _leaves_its_rows(self, call: _Call, piece: Piece, new_bits: Tensor, old_bits: Tensor) -> bool:
        if call.mask_E is None:
            return False
        kind = call.scope.partition("/")[0]
        # What an event keeps, and what it presses with, may go on in rows in which nothing new begins. In a rehearsal
        # nothing has begun.
        goes_on = call.owns(piece) or (piece.owner == INPUT and not self._rehearses)
        if kind != "commands" and goes_on:
            return False
        if not piece.has_rows:
            return not bool(call.mask_E.any())
        others_E = ~call.mask_E
        return not torch.equal(new_bits[others_E], old_bits[others_E])

    # -- rehearsal -----------------------------------------------------------------------------------------------

    @contextmanager
    def rehearsal(self) -> Iterator[None]:
        """Watch each call in this block in a state in which no number is zero, and put everything back at its end.

        A write that changes nothing in the state of an env that was just built, as `numpy.clip` of zeros, shows there.
        """
        simulation = self._simulation
        kept = [(piece, piece.tensor.clone()) for piece in self._memory.lasting() if piece.tensor is not None]
        for piece, _ in kept:
            if piece.owner in (STATE, MOCAP, INPUT) and piece.tensor.is_floating_point():
                piece.tensor.add_(_odd_numbers(piece.tensor))
        # Servos hold their targets, as they do after each reset.
        everybody_E = torch.ones(simulation.num_envs, dtype=torch.bool, device=simulation.device)
        self._view.targets.reset(everybody_E)
        simulation.world.refresh()
        simulation.refreshed()
        self._rehearses = True
        try:
            with self.watching():
                yield
        finally:
            self._rehearses = False
            for piece, old in kept:
                piece.tensor.copy_(old)
            simulation.world.refresh()
            simulation.refreshed()


def _odd_numbers(like: Shaped[Tensor, "*shape"]) -> Tensor:
    """Return numbers in [0.01, 0.02], no two neighbors of which are equal, in the shape of a tensor."""
    places = torch.arange(like.numel(), dtype=torch.float64, device=like.device)
    golden = 0.6180339887498949
    return (0.01 + 0.01 * (golden * places).frac()).to(like.dtype).view(like.shape)


def _bits(tensor: Shaped[Tensor, "*shape"]) -> Tensor:
    """Return the bits of numbers, as NaN equals no NaN, and 0 equals -0."""
    if not tensor.is_floating_point():
        return tensor
    return tensor.view({2: torch.int16, 4: torch.int32, 8: torch.int64}[tensor.element_size()])


def _refusal(call: _Call, how: str, name: str, piece: Piece, *, by_view: bool = False) -> str:
    """Return what a term did wrong, why that is wrong, and what to write instead."""
    effect = ", which moves the robot" if piece.owner == STATE else ""
    if by_view:
        fix = "Write positions and velocities by `view.write_qpos`, `view.joints(...).write_pos` and their like"
    else:
        read = name if name.startswith("view.") else "x"
        fix = f"Write `error = {read} - 0.5` instead of `error = {read}; error -= 0.5`, or change `{read}.clone()`"
    return f"{type(call.part).__name__} {how}{effect}: {call.rule.noun} {call.rule.may}. {fix}"
