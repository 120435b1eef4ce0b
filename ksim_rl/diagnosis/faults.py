"""A function for each fault of learning that metrics show: threshold, reason, and what to change.

A function takes the curves of a run and returns what it saw, or None. One whose metrics a run does not log, since its
algorithm has no such thing, sees nothing. `EXPLAINS` says which faults follow from others.
"""

import math
import statistics
from collections.abc import Callable, Mapping

from ksim_rl.diagnosis.curves import Curves
from ksim_rl.modules.actor_cfg import MIN_STD

# A function of the curves that returns the evidence, or None where the fault is not seen.
Fault = Callable[[Curves], str | None]


def std_at_floor(curves: Curves) -> str | None:
    """The standard deviation of the actions is at its lower bound, where nothing is explored and ratios are extreme.

    Raise objective.entropy_coeff (of SAC: objective.target_entropy_per_action) or modules.actor.init_std, or look for a
    reward that punishes every action.
    """
    std = curves.late("policy/std")
    # The library's bound, or the config's where that is higher.
    floor = max(MIN_STD, math.exp(curves.setting("modules.actor.log_std_min", -math.inf)))
    # Three times the bound, since it is a mean over actions, some of which may lie above.
    if _below(std, 3.0 * floor):
        return f"policy/std is {std:.2g}, and its bound {floor:.2g}"
    return None


def entropy_collapsed(curves: Curves) -> str | None:
    """The policy stopped exploring: its actions scatter by a tenth of their first spread, or less.

    Raise objective.entropy_coeff, or lower objective.learning_rate or objective.desired_kl.
    """
    # The entropy of densities has no zero to compare with, but their std has; entropies of choices are never negative.
    if curves.values("policy/std"):
        name = "policy/std"
    else:
        name = "loss/entropy"
    # A tenth of its first value: learning narrows it too, but not that far.
    first = curves.early(name)
    last = curves.late(name)
    if first is None or last is None or first <= 0.0 or not 0.0 <= last <= 0.1 * first:
        return None
    return f"{name} fell from {first:.3g} to {last:.2g}"


def value_error_exploding(curves: Curves) -> str | None:
    """The error of the values grows beyond any return that the rewards allow: the critic runs away.

    Lower the critic's learning rate or objective.tau, bring objective.gamma below 1, use objective.value_reduction=min,
    or scale the rewards down.
    """
    # Off policy it is zero until learning starts.
    errors = [error for error in curves.values("loss/value") if error > 0.0]
    rewards = [abs(reward) for reward in curves.values("rollout/reward")]
    last = curves.late("loss/value")
    if last is None or not errors or not rewards:
        return None
    # The return of the largest mean reward, discounted or up to the end of an episode; a loss is a squared error.
    steps = 1.0 / max(1.0 - curves.setting("objective.gamma", 0.99), 1e-3)
    largest = max(rewards) * min(steps, max(curves.values("episode/length"), default=steps))
    # Over the first values, since the error also falls as the critic learns.
    first = statistics.median(errors[: max(3, len(errors) // 5)])
    # Both: grown tenfold, and larger than the square of any return could be.
    if last > 10.0 * first and last > (2.0 * largest) ** 2:
        return f"loss/value rose to {last:.3g}, where returns are at most about {largest:.2g}"
    return None


def negative_explained_variance(curves: Curves) -> str | None:
    """The critic predicts returns worse than their mean would: advantages are noise.

    Raise objective.critic_coeff, let the critic see more (its observation group), lower
    modules.critic.output_gain, or lower objective.gamma.
    """
    share = curves.late("update/explained_variance")
    # A critic that predicts the mean has 0; a little below is noise.
    if _below(share, -0.2):
        return f"update/explained_variance is {share:.2g}"
    return None


def kl_far_off(curves: Curves) -> str | None:
    """An update moves the policy ten times as far as objective.desired_kl, so that old data says nothing about it.

    Use objective.schedule=adaptive, lower objective.learning_rate (and objective.learning_rate_min), or raise the size
    of a minibatch.
    """
    kl = curves.late("update/kl")
    desired = curves.setting("objective.desired_kl", 0.01)
    if _above(kl, 10.0 * desired):
        return f"update/kl is {kl:.2g} nats, {desired:.2g} desired"
    return None


def most_ratios_clipped(curves: Curves) -> str | None:
    """Most env states have no gradient, since their probability ratios lie outside of the clipping range.

    Raise objective.clip_epsilon (0.2 is usual), or lower objective.num_epochs or objective.learning_rate.
    """
    share = curves.late("update/clip_fraction")
    if _above(share, 0.5):
        return f"update/clip_fraction is {share:.0%}"
    return None


def episodes_end_at_once(curves: Curves) -> str | None:
    """Episodes end within a few steps to the last, so that there is nothing to learn from.

    Loosen the termination that is named, or start where it does not hold (events of mode reset).
    """
    length = curves.late("episode/length")
    # Fewer steps than any task needs to show a difference.
    if not _below(length, 5.0):
        return None
    # The share of each termination tells which of them to loosen.
    ends = {name: curves.late(name) or 0.0 for name in curves.names("termination")}
    worst = max(ends, key=lambda name: ends[name], default=None)
    if worst is None:
        cause = ""
    else:
        cause = f"; {ends[worst]:.0%} by {worst.removeprefix('termination/')}"
    return f"episode/length is {length:.2g} steps{cause}"


def penalty_outweighs(curves: Curves) -> str | None:
    """One penalty is ten times as large as all rewards together: it pays to do nothing, or to end the episode.

    Lower the weight of that reward, task.rewards.<name>.weight, or let a curriculum raise it later.
    """
    terms = {name: curves.late(name) or 0.0 for name in curves.names("reward")}
    earned = sum(max(value, 0.0) for value in terms.values())
    # The lowest term; there may be no penalty at all.
    worst = min(terms, key=lambda name: terms[name], default=None)
    if worst is None or not earned or -terms[worst] < 10.0 * earned:
        return None
    return f"{worst} is {terms[worst]:.3g}, and all rewards together {earned:.2g}"


def saturated_actions(curves: Curves) -> str | None:
    """Nearly all actions lie on or beyond their bounds, where changing them changes nothing.

    Lower modules.actor.init_std or modules.actor.output_gain, raise the scale of the action term, or use
    modules.actor.distribution=tanh_gaussian.
    """
    share = curves.last("rollout/saturated_actions")
    if _above(share, 0.95):
        return f"rollout/saturated_actions is {share:.0%}"
    return None


def dead_units(curves: Curves) -> str | None:
    """Most hidden units say the same in every state: the networks are smaller than they look.

    Use modules.actor.activation=elu (or layer_norm=true off policy), lower the learning rate, and normalize the
    observations (obs_normalization=true).
    """
    share = curves.last("policy/dead_units")
    if _above(share, 0.5):
        return f"policy/dead_units is {share:.0%}"
    return None


def stale_normalizer(curves: Curves) -> str | None:
    """Normalized observations are far from the size 1 that they should have: the statistics are of other observations.

    Let the normalizers go on learning, look for an observation that jumps or grows without bound, and do not begin from
    the checkpoint of a task with other observations.
    """
    # 1 is the aim; a factor of a few is no harm.
    size = curves.last("policy/observation_rms")
    off = size is not None and not 0.2 < size < 4.0
    if off:
        return f"policy/observation_rms is {size:.2g}"
    return None


# Order of the report: a cause stands before the faults that follow from it.
FAULTS: tuple[Fault, ...] = (
    episodes_end_at_once,
    stale_normalizer,
    std_at_floor,
    entropy_collapsed,
    saturated_actions,
    dead_units,
    kl_far_off,
    most_ratios_clipped,
    value_error_exploding,
    negative_explained_variance,
    penalty_outweighs,
)
"""All of them, causes first."""

EXPLAINS: Mapping[Fault, tuple[Fault, ...]] = {
    # Returns that are all alike have no variance to explain.
    episodes_end_at_once: (negative_explained_variance, penalty_outweighs),
    # Ratios are extreme where nothing scatters.
    std_at_floor: (entropy_collapsed, kl_far_off, most_ratios_clipped),
    entropy_collapsed: (kl_far_off, most_ratios_clipped),
    # Steps that are too long destroy what the networks have learned.
    kl_far_off: (
        saturated_actions,
        most_ratios_clipped,
        value_error_exploding,
        negative_explained_variance,
        dead_units,
    ),
    stale_normalizer: (dead_units, kl_far_off, most_ratios_clipped, negative_explained_variance),
}
"""Faults that follow from a fault, and are not told when it is."""


def _above(value: float | None, limit: float) -> bool:
    return value is not None and value > limit


def _below(value: float | None, limit: float) -> bool:
    return value is not None and value < limit
