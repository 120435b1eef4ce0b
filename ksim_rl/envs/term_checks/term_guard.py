"""Refuses terms that write memory that is not theirs, by name: such as a reward that moves the robot."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import NamedTuple

import torch
from jaxtyping import Bool, Shaped
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import PyTree

from ksim_rl.device import recording
from ksim_rl.device.recording import OpArgs, OpKwargs, OpOverload
from ksim_rl.envs.term_checks.term_memory import INPUT, MOCAP, STATE, Piece, TermMemory, bits_of
from ksim_rl.envs.term_checks.term_rules import may_write, refusal
from ksim_rl.envs.view import EnvView, Readings
from ksim_rl.scene.state.buffers import Kept
from ksim_rl.scene.state.simulation import UNWATCHED, Simulation


class _Writes(TorchDispatchMode):
    """Shows each tensor to `look` before an operator writes it, with the operator's name.

    Every way to the tensor (a slice, `.data`, `detach`, `out=`, TorchScript) ends in torch's dispatcher, and so here.
    """

    def __init__(self, look: Callable[[str, Tensor], None]) -> None:
        super().__init__()
        self._look = look

    def __torch_dispatch__(
        self,
        func: OpOverload,
        types: Sequence[type],
        args: OpArgs = (),
        kwargs: OpKwargs | None = None,
    ) -> PyTree:
        kwargs = kwargs or {}
        for tensor in recording.written_by(func, args, kwargs):
            self._look(func.overloadpacket.__name__, tensor)
        return func(*args, **kwargs)


class _Call(NamedTuple):
    """One watched call of a term, and the tensors of its own that it has written so far."""

    scope: str
    part: object
    mask_E: Tensor | None
    written: dict[str, Kept]


class _Copy(NamedTuple):
    """The bits of a tensor that terms can reach, and a copy of them; the piece is None for a quantity."""

    piece: Piece | None
    bits: Tensor
    old_bits: Tensor


class TermGuard:
    """Watches the writes of terms where that costs little, and refuses those outside of their memory by a ValueError.

    Torch's writes are refused before they happen: at a term's first call, while a step is recorded or captured, and in
    the blocks of `watching` and `rehearsal`. Writes past torch (NumPy, Warp) show in the bits of lasting memory, which
    are compared while a step is recorded and in these blocks. Any other call costs one look-up.
    """

    def __init__(self, simulation: Simulation, readings: Readings, view: EnvView) -> None:
        self._simulation = simulation
        self._view = view
        self._memory = TermMemory(simulation, readings, view)
        self._on_cuda = torch.device(simulation.device).type == "cuda"
        self._seen: set[tuple[str, int]] = set()
        self._is_on = False
        self._compares = False
        self._rehearses = False

    @contextmanager
    def watching(self, *, past_torch: bool = True) -> Iterator[None]:
        """Watch each call in this block, `past_torch` too, which makes the host wait for the device."""
        before = self._is_on, self._compares
        self._is_on = True
        self._compares = past_torch
        try:
            yield
        finally:
            self._is_on, self._compares = before

    @contextmanager
    def rehearsal(self) -> Iterator[None]:
        """Watch each call in this block in a state in which no number is zero, and put everything back at its end.

        A write that changes nothing in the state of an env that was just built, as `numpy.clip` of zeros, shows there.
        """
        simulation = self._simulation
        # Copies of everything first, then a state in which a write by a factor or a clip shows.
        kept: list[tuple[Tensor, Tensor]] = []
        for piece in self._memory.lasting():
            if piece.tensor is None:
                continue
            kept.append((piece.tensor, piece.tensor.clone()))
            if piece.owner in (STATE, MOCAP, INPUT) and piece.tensor.is_floating_point():
                piece.tensor.add_(_odd_numbers(piece.tensor))
        # Servos hold their targets, as they do after each reset.
        everybody_E = torch.ones(simulation.num_envs, dtype=torch.bool, device=simulation.device)
        self._view.targets.reset(everybody_E)
        # Derived quantities must follow from the odd numbers before a term reads them.
        simulation.world.refresh()
        simulation.refreshed()
        self._rehearses = True
        try:
            with self.watching():
                yield
        finally:
            self._rehearses = False
            for tensor, old in kept:
                tensor.copy_(old)
            simulation.world.refresh()
            simulation.refreshed()

    def watch(
        self, scope: str, part: object, mask_E: Bool[Tensor, " E"] | None
    ) -> AbstractContextManager[Mapping[str, Kept]]:
        """Return the watch of one call of `part`, which yields its own tensors that it writes; None is not watched.

        `mask_E` are the rows that it may write; without it, all.
        """
        if part is None:
            return UNWATCHED
        # The first call of each term is always watched; later ones only where that is asked for.
        key = scope, id(part)
        is_recorded = recording.is_recording()
        is_captured = self._on_cuda and torch.cuda.is_current_stream_capturing()
        if key in self._seen and not (self._is_on or is_recorded or is_captured):
            return UNWATCHED
        self._seen.add(key)
        # A capture allows no look at the device.
        compares = (self._compares or is_recorded) and not is_captured
        return self._watched(_Call(scope, part, mask_E, {}), compares=compares)

    @contextmanager
    def _watched(self, call: _Call, *, compares: bool) -> Iterator[Mapping[str, Kept]]:
        # The state of all memory before the call, for writes that torch does not see.
        before = self._copied() if compares else []
        refusals: list[ValueError] = []

        def look(operator: str, tensor: Tensor) -> None:
            found = self._look(call, operator, tensor)
            if found is not None:
                refusals.append(found)
                raise found

        try:
            with _Writes(look):
                yield call.written
        except Exception as error:
            # TorchScript wraps it in another error, whose text says nothing.
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
        """Return the error for a write that is not allowed, else None."""
        piece = self._memory.holder(tensor)
        if piece is None:
            return None
        is_allowed = may_write(call.scope, piece)
        # Who may write state does so by the view's methods, which know the rows and what becomes stale.
        if is_allowed and (piece.owner != STATE or self._simulation.is_writing):
            self._keep(call, piece)
            return None
        # The error names the tensor as the term's author would write it.
        name = self._memory.spelled(tensor, piece)
        how = f"writes into {name} in place (`{operator}`)"
        return ValueError(refusal(call.scope, call.part, how, name, piece))

    def _keep(self, call: _Call, piece: Piece) -> None:
        """Remember a tensor of the term's own that it writes, and so advances with each call."""
        is_own = piece.owner in (call.scope, MOCAP)
        if is_own and piece.tensor is not None:
            call.written[piece.name] = Kept(piece.tensor, piece.has_rows)

    # -- past torch ----------------------------------------------------------------------------------------------

    def _copied(self) -> list[_Copy]:
        """Return a copy of all that terms can reach."""
        with recording.paused():
            copies = [
                _Copy(piece, piece.bits, piece.bits.clone())
                for piece in self._memory.lasting()
                if piece.bits is not None
            ]
            for tensor in self._memory.quantities():
                bits = bits_of(tensor)
                copies.append(_Copy(None, bits, bits.clone()))
        return copies

    def _compare(self, call: _Call, before: list[_Copy]) -> None:
        """Refuse changes of memory that is not the term's, or not in its rows."""
        with recording.paused():
            for piece, bits, old_bits in before:
                # Most pieces are untouched: the cheap test comes first.
                if torch.equal(bits, old_bits):
                    continue
                piece = piece or self._memory.holder(bits)
                # An event that writes state also empties the caches, so that this quantity is no longer read.
                if piece is None:
                    continue
                if not may_write(call.scope, piece):
                    how = f"changes {piece.name} past torch (by NumPy, Warp or an address)"
                    raise ValueError(refusal(call.scope, call.part, how, piece.name, piece))
                self._keep(call, piece)
                if self._leaves_its_rows(call, piece, bits, old_bits):
                    raise ValueError(
                        f"{type(call.part).__name__} changes {piece.name} in rows outside of its mask: write "
                        "`torch.where(mask, new, old)`, or through `view.write_*(mask_E, ...)`"
                    )

    def _leaves_its_rows(self, call: _Call, piece: Piece, bits: Tensor, old_bits: Tensor) -> bool:
        """Whether a call with a mask has changed rows outside of the mask."""
        if call.mask_E is None:
            return False
        # An event may change its buffers and forces in all rows, in a rehearsal its buffers alone. A command
        # may change only the rows that it draws for.
        is_pressing = piece.owner == INPUT and not self._rehearses
        is_kept = piece.owner == call.scope and not call.scope.startswith("commands/")
        if is_pressing or is_kept:
            return False
        # A piece that all envs share may change only if the event has rows to act on.
        if not piece.has_rows:
            return not bool(call.mask_E.any())
        others_E = ~call.mask_E
        return not torch.equal(bits[others_E], old_bits[others_E])


def _odd_numbers(like: Shaped[Tensor, "*shape"]) -> Tensor:
    """Return numbers in [0.01, 0.02] in the shape of a tensor; neighbors always differ."""
    # Multiples of the golden ratio, modulo 1, are spread evenly, so neighbors differ.
    places = torch.arange(like.numel(), dtype=torch.float64, device=like.device)
    golden_ratio = 0.6180339887498949
    spread = 0.01 + 0.01 * (golden_ratio * places).frac()
    return spread.to(like.dtype).view(like.shape)
