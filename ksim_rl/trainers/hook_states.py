"""Pairs the hooks of a resumed run with the states that its checkpoint has for them."""

from collections.abc import Callable, Sequence
from typing import TypeVar

from ksim_rl.device.state_tree import State, branch

H = TypeVar("H")


def paired(
    hooks: Sequence[H], saved: State, *, keeps: Callable[[H], bool]
) -> list[tuple[H, State]]:
    """Pair hooks, in their order, with the states saved by number; a ValueError where they are of another run.

    Hooks that keep nothing, such as a viewer's, may come and go between the sessions of a run; `keeps` knows others.
    """
    # Numbers are texts in a checkpoint: "10" comes after "9".
    states = [branch(saved, number) for number in sorted(saved, key=int)]
    own = list(hooks)
    # Another number of hooks: leave out those that have no state on either side.
    if len(states) != len(own):
        states = [state for state in states if state]
        own = [hook for hook in own if keeps(hook)]
    if len(states) != len(own):
        raise ValueError(
            f"the checkpoint is of a run with {len(states)} hooks that keep something, and this one has {len(own)}"
        )
    return list(zip(own, states, strict=True))
