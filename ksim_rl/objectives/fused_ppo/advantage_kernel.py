"""This module estimates generalized advantages in one Triton kernel."""

import triton
import triton.language as tl


@triton.jit
def estimate_advantages(
    values,
    next_values,
    rewards,
    done,
    terminated,
    advantages,
    targets,
    num_envs,
    gamma,
    decay,
    STEPS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Write advantages and value targets of BLOCK envs; all signals are time-major, [STEPS, num_envs].

    As `GAE`: a step whose delta is not finite gets a NaN advantage, and the recursion starts anew before it.

    Args:
        gamma: discount.
        decay: gamma * lambda.
    """
    env = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = env < num_envs
    advantage = tl.zeros((BLOCK,), dtype=tl.float32)
    for back in range(1, STEPS + 1):
        at = (STEPS - back) * num_envs + env
        value = tl.load(values + at, mask=inside, other=0.0)
        following = gamma * tl.load(next_values + at, mask=inside, other=0.0)
        reward = tl.load(rewards + at, mask=inside, other=0.0)
        ended = tl.load(done + at, mask=inside, other=1) != 0
        bootstrap = tl.where(tl.load(terminated + at, mask=inside, other=1) != 0, 0.0, following)
        delta = reward + bootstrap - value
        finite = tl.abs(delta) < float("inf")
        carried = tl.where(finite & (ended == 0), decay, 0.0) * advantage
        advantage = tl.where(finite, delta, 0.0) + carried
        tl.store(targets + at, advantage + value, mask=inside)
        tl.store(advantages + at, tl.where(finite, advantage, float("nan")), mask=inside)
