"""Says what each kind of term may write, besides its buffers: a reward nothing, an event the state in its rows."""

from dataclasses import dataclass

from ksim_rl.envs.term_checks.term_memory import (
    DIFFICULTY,
    FIELD,
    INPUT,
    MOCAP,
    PARAMETER,
    STATE,
    Piece,
)

_READS = "only reads what the view gives it, and keeps what it must in `view.buffer`"
# Positions and velocities only by `view.write_qpos` and its like, which know the rows and what becomes stale.
_DRIVES = frozenset((STATE, MOCAP, INPUT, PARAMETER))


@dataclass(frozen=True, kw_only=True)
class Rule:
    """The name of a kind of term, its purpose, and the owners of pieces (see `Piece`) that it `writes`."""

    noun: str
    does: str
    writes: frozenset[str] = frozenset()


RULES = {
    "observations": Rule(noun="an observation", does=_READS),
    "rewards": Rule(noun="a reward", does=_READS),
    "terminations": Rule(noun="a termination", does=_READS),
    "metrics": Rule(noun="a metric", does=_READS),
    "commands": Rule(
        noun="a command",
        does="only reads what the view gives it, keeps what it must in `view.buffer`, and may move mocap bodies",
        # Where its target is shown.
        writes=frozenset((MOCAP,)),
    ),
    "actuators": Rule(
        noun="the law of an actuator", does="only reads state and targets, and returns the control"
    ),
    "sensors": Rule(
        noun="a sensor",
        does="only reads the worlds, and keeps what it must in buffers",
        writes=frozenset((PARAMETER,)),
    ),
    "actions": Rule(
        noun="an action",
        does="writes targets, controls and other inputs of the worlds",
        writes=_DRIVES,
    ),
    "events": Rule(
        noun="an event",
        does="writes state, inputs and model fields of the worlds, in the rows of its mask",
        writes=_DRIVES | {FIELD},
    ),
    "curriculum": Rule(
        noun="a curriculum",
        does="writes difficulty: `view.level`, reward weights, ranges of commands, levels of a terrain",
        writes=frozenset((DIFFICULTY, FIELD, PARAMETER)),
    ),
}
"""By the kind of a scope: "rewards" of "rewards/upright"."""


def rule_of(scope: str) -> Rule:
    """Return the rule of the term that runs in a scope."""
    return RULES[scope.partition("/")[0]]


def may_write(scope: str, piece: Piece) -> bool:
    """Whether the term of a scope may write a piece of memory by any means, the view's or its own."""
    if piece.owner == scope:
        return True
    writes = rule_of(scope).writes
    # The ranges that a command draws from are its own, and a curriculum widens them.
    is_range = piece.owner.startswith("commands/") and not piece.has_rows
    return piece.owner in writes or (is_range and DIFFICULTY in writes)


def refusal(scope: str, part: object, how: str, name: str, piece: Piece) -> str:
    """Return the error text for a write to `name`: what the term did, why that is wrong, and what to write instead."""
    rule = rule_of(scope)
    if piece.owner == STATE:
        effect = ", which moves the robot"
    else:
        effect = ""
    # The advice repeats the term's own expression where it has one.
    # Only names that begin with "view." are valid code in a term.
    read = name if name.startswith("view.") else "x"
    fix = f"Write `error = {read} - 0.5` instead of `error = {read}; error -= 0.5`, or change `{read}.clone()`"
    # It may write this, but not in place: the view's methods keep caches and rows right.
    if may_write(scope, piece):
        fix = "Write positions and velocities by `view.write_qpos`, `view.joints(...).write_pos` and their like"
    return f"{type(part).__name__} {how}{effect}: {rule.noun} {rule.does}. {fix}"
