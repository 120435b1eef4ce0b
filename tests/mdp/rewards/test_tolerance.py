"""The rating of dm_control's suite, by the values that define it."""

import pytest
import torch

from ksim_rl.mdp.rewards.tracking import tolerance


@pytest.mark.parametrize("shape", ["gaussian", "linear"])
def test_one_inside_and_the_given_value_at_the_margin(shape):
    value = torch.tensor([1.0, 1.5, 2.0, 0.5, 2.5])
    rated = tolerance(value, low=1.0, high=2.0, margin=0.5, value_at_margin=0.3, shape=shape)
    torch.testing.assert_close(rated, torch.tensor([1.0, 1.0, 1.0, 0.3, 0.3]))


def test_beyond_the_margin():
    far = torch.tensor([0.0, -3.0])
    linear = tolerance(far, low=2.0, margin=4.0, value_at_margin=0.5, shape="linear")
    torch.testing.assert_close(linear, torch.tensor([0.75, 1.0 - 0.5 * 1.25]))
    assert (
        tolerance(torch.tensor(-10.0), low=2.0, margin=4.0, shape="linear", value_at_margin=0.0)
        == 0.0
    )
    # Two margins away, a gaussian has the value to the fourth power.
    torch.testing.assert_close(
        tolerance(torch.tensor(3.0), high=1.0, margin=1.0), torch.tensor(0.1**4)
    )


def test_an_open_side_is_right_however_far():
    assert tolerance(torch.tensor(1e9), low=2.0, margin=1.0) == 1.0
    assert tolerance(torch.tensor(-1e9), high=2.0, margin=1.0) == 1.0
