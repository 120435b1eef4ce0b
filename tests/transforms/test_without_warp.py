"""Where Warp is not installed, torch computes what the kernels of transforms do."""

import pytest
import torch
from tensordict import NestedKey

from ksim_rl.device import quick_launch, random
from ksim_rl.ranks.running_moments import RunningMoments
from tests.transforms.chains import actions
from tests.transforms.transform_checks import KINDS, masked

SEED = torch.tensor(2**40 + 5)
STREAM = 2**31 - 7


@pytest.fixture
def without_warp(monkeypatch):
    """Return a function after which operators find no Warp."""
    return lambda: monkeypatch.setattr(quick_launch, "has_warp", lambda: False)


def draws(counter: torch.Tensor) -> list[torch.Tensor]:
    keys = random.row_keys(SEED, STREAM, counter, 4)
    wide = torch.full((4, 1), 2**33)
    return [
        random.uniform(keys, 9),
        random.integers(keys, 9, -3, 2**31 - 5),
        random.integers(keys, 9, -wide, wide),
        random.uniform(keys, 9, -2.0, 7.0),
        random.normal(keys, 5000),
    ]


@pytest.mark.parametrize("counter", [torch.tensor(2**34 + 1), torch.tensor([3, 0, 2**33, 1])])
def test_draws_have_the_same_bits(without_warp, counter):
    by_kernel = draws(counter)
    without_warp()
    in_torch = draws(counter)
    for one, other in zip(by_kernel[:3], in_torch[:3], strict=True):
        assert torch.equal(one, other)
    # These are rounded otherwise.
    for one, other in zip(by_kernel[3:], in_torch[3:], strict=True):
        torch.testing.assert_close(one, other, rtol=2e-6, atol=1e-6)


@pytest.mark.parametrize("n", [0, 1, 5, 64, 300])
def test_orders_are_the_same(without_warp, n):
    keys = random.row_keys(SEED, STREAM, torch.tensor([4, 9]), 3)
    by_kernel = random.permutations(keys, n)
    without_warp()
    assert torch.equal(by_kernel, random.permutations(keys, n))


def test_counters_that_would_be_misread_are_refused(without_warp):
    without_warp()
    with pytest.raises(
        ValueError, match=r"expected torch.int64, and a counter of shape \(\) or \(4,\)"
    ):
        random.uniform(random.row_keys(SEED, STREAM, torch.zeros(3, dtype=torch.int64), 4), 2)


def rolled_out(kind: str) -> dict[NestedKey, torch.Tensor]:
    env = masked(kind)
    steps = iter(actions(12, env))
    rollout_ET = env.rollout(
        12, lambda td: td.set(env.action_key, next(steps)), break_when_any_done=False
    )
    return dict(rollout_ET.items(True, True))


@pytest.mark.parametrize("kind", KINDS)
def test_transforms_do_the_same(without_warp, kind):
    by_kernel = rolled_out(kind)
    without_warp()
    in_torch = rolled_out(kind)
    assert in_torch.keys() == by_kernel.keys()
    for key, value in by_kernel.items():
        torch.testing.assert_close(
            in_torch[key], value, rtol=2e-6, atol=2e-6, msg=lambda text, key=key: f"{key}: {text}"
        )


def moments(until: int | None) -> list[torch.Tensor]:
    counted = RunningMoments(3, until=until)
    generator = torch.Generator().manual_seed(2)
    for num_rows in (700, 3, 5, 40):
        rows = torch.randn(num_rows, 3, generator=generator) * 1e3 + 1e4
        rows[num_rows // 2, 1] = torch.nan
        counted.update(rows, torch.rand(num_rows, generator=generator) < 0.8)
    return list(counted.state_dict().values())


@pytest.mark.parametrize("until", [None, 400, 1])
def test_moments_are_the_same(without_warp, until):
    by_kernel = moments(until)
    without_warp()
    for one, other in zip(by_kernel, moments(until), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=0.0)
