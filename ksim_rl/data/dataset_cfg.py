"""This module has the sizes of dataset, minibatch and rollout, and the arithmetic between them."""

import math
from dataclasses import dataclass

from ksim_rl.checks import check_count


@dataclass(frozen=True, kw_only=True)
class DatasetCfg:
    """How many env states one RL update uses, and in how many gradient steps an epoch splits them.

    Attributes:
        num_env_states_per_minibatch: B, env states in one gradient step.
        num_minibatches: gradient steps per epoch.
        sequence_length: recurrent networks learn on so many successive steps of an env; None takes the whole rollout.
        burn_in: so many steps before a sequence renew its first state, which is stored otherwise.
    """

    num_env_states_per_minibatch: int
    num_minibatches: int
    sequence_length: int | None = None
    burn_in: int = 0

    def __post_init__(self) -> None:
        """Refuse values that are no positive whole numbers, naming the field."""
        for field in ("num_env_states_per_minibatch", "num_minibatches"):
            check_count(field, getattr(self, field))
        if self.sequence_length is not None:
            check_count("sequence_length", self.sequence_length)
        check_count("burn_in", self.burn_in, low=0)

    @property
    def num_env_states(self) -> int:
        """D, the size of the dataset."""
        return self.num_env_states_per_minibatch * self.num_minibatches

    def rollout_length(self, num_envs: int) -> int:
        """Return T for so many parallel environments; see `rollout_length`."""
        return rollout_length(self.num_env_states_per_minibatch, self.num_minibatches, num_envs)


def rollout_length(num_env_states_per_minibatch: int, num_minibatches: int, num_envs: int) -> int:
    """Return T, the steps that each env takes for one dataset: D / num_envs.

    Raises:
        ValueError: if T is no whole number; the message has the three numbers and the nearest working values
            of each.
    """
    check_count("num_env_states_per_minibatch", num_env_states_per_minibatch)
    check_count("num_minibatches", num_minibatches)
    check_count("num_envs", num_envs)
    num_env_states = num_env_states_per_minibatch * num_minibatches
    if num_env_states % num_envs == 0:
        return num_env_states // num_envs

    # n * M is a multiple of E exactly when n is a multiple of E / gcd(E, M).
    per_minibatch = _near_multiples(
        num_env_states_per_minibatch, num_envs // math.gcd(num_envs, num_minibatches)
    )
    minibatches = _near_multiples(
        num_minibatches, num_envs // math.gcd(num_envs, num_env_states_per_minibatch)
    )
    envs = _near_divisors(num_env_states, num_envs)
    raise ValueError(
        f"num_env_states_per_minibatch={num_env_states_per_minibatch} * num_minibatches={num_minibatches} = "
        f"{num_env_states} env states cannot be shared equally by num_envs={num_envs}: each env would take "
        f"{num_env_states / num_envs:.4g} steps. Change one of them: "
        f"num_env_states_per_minibatch={per_minibatch}, num_minibatches={minibatches} or num_envs={envs}"
    )


def _near_multiples(value: int, factor: int) -> str:
    below = value // factor * factor
    return " or ".join(str(number) for number in (below, below + factor) if number > 0)


def _near_divisors(number: int, value: int) -> str:
    small = [divisor for divisor in range(1, math.isqrt(number) + 1) if number % divisor == 0]
    divisors = sorted({*small, *(number // divisor for divisor in small)})
    near = [divisor for divisor in divisors if divisor < value][-1:]
    near += [divisor for divisor in divisors if divisor > value][:1]
    return " or ".join(str(divisor) for divisor in near)
