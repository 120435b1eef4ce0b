"""Our real parts on problems whose answers are known; each fails for one kind of fault only, in this order.

The values hold for Run's discount, 0.5.
"""

import pytest
import torch

from tests.integration.probes import ProbeEnv, Run, blank, one, sign_only, step_only, the_sign


def test_the_value_of_a_constant_reward():
    # One step, reward 1, termination: V = 1. If not: the value loss or its optimizer.
    run = Run(ProbeEnv(blank, one, length=1)).iterate(8)
    assert run.values(0) == pytest.approx(1.0, abs=0.05)


def test_the_value_follows_the_observation():
    # V = sign. If not: observations and targets do not belong together (a shuffle, a reset, a flattening).
    run = Run(ProbeEnv(sign_only, the_sign, length=1)).iterate(8)
    assert run.values(0, 1.0) == pytest.approx(1.0, abs=0.1)
    assert run.values(0, -1.0) == pytest.approx(-1.0, abs=0.1)


def test_a_delayed_reward_is_discounted_back():
    # Reward 1 at the last of three steps: V = 1/4, 1/2, 1. If not: the recursion, or the discount.
    def last(step_E, sign_E, action_E, first_E):
        return (step_E == 2).float()

    run = Run(ProbeEnv(step_only, last, length=3)).iterate(14)
    assert [run.values(step) for step in range(3)] == pytest.approx([0.25, 0.5, 1.0], abs=0.08)


def test_truncation_bootstraps_and_termination_does_not():
    # Reward `sign` at each of two steps. Terminated: V = 1.5 and 1 times the sign. Truncated: the episode would have
    # gone on, V = 2 times the sign. The next episode's sign says nothing about this one.
    def observe(step_E, sign_E):
        return torch.stack((sign_E, sign_E * step_E.clamp_max(1)), dim=-1)

    ended = Run(ProbeEnv(observe, the_sign, length=2), advantage="td_lambda").iterate(12)
    cut = Run(ProbeEnv(sign_only, the_sign, length=2, truncates=True), advantage="vtrace").iterate(
        12
    )
    for sign in (1.0, -1.0):
        assert ended.values(0, sign) == pytest.approx(1.5 * sign, abs=0.15)
        assert ended.values(1, sign) == pytest.approx(1.0 * sign, abs=0.15)
        assert cut.values(0, sign) == pytest.approx(2.0 * sign, abs=0.2)


def test_the_policy_finds_the_action_that_pays():
    # Reward -(a - 0.8)^2. If not: the sign of the policy loss, the ratio, or the advantage.
    def near(step_E, sign_E, action_E, first_E):
        return -(action_E - 0.8).square()

    run = Run(ProbeEnv(blank, near, length=1)).iterate(8)
    assert run.action(0) == pytest.approx(0.8, abs=0.25)


def test_the_policy_finds_the_action_that_the_observation_asks_for():
    # Reward -(a - 0.8 sign)^2. If not: actions, advantages and observations do not belong together.
    def near(step_E, sign_E, action_E, first_E):
        return -(action_E - 0.8 * sign_E).square()

    run = Run(ProbeEnv(sign_only, near, length=1)).iterate(10)
    assert run.action(0, 1.0) == pytest.approx(0.8, abs=0.25)
    assert run.action(0, -1.0) == pytest.approx(-0.8, abs=0.25)


def test_an_action_is_credited_with_what_it_pays_later():
    # The first action pays at the second step, where nothing can be changed. If not: advantages stop at one step.
    def later(step_E, sign_E, action_E, first_E):
        return torch.where(step_E == 1, -(first_E - 0.8).square(), 0.0)

    run = Run(ProbeEnv(step_only, later, length=2)).iterate(12)
    assert run.action(0) == pytest.approx(0.8, abs=0.25)
