import pytest
import torch
from torch.distributions import Categorical, Independent, Normal
from torch.distributions import kl_divergence as torch_kl
from torchrl.modules import TanhNormal

from ksim_rl.objectives import kl_divergence
from ksim_rl.objectives.policy_kl import gaussian_parameters


def test_equals_torchs_closed_form():
    loc_old, loc = torch.randn(2, 6, 4, 3)
    scale_old, scale = torch.rand(2, 6, 4, 3) + 0.05
    expected = torch_kl(
        Independent(Normal(loc_old, scale_old), 1), Independent(Normal(loc, scale), 1)
    )
    torch.testing.assert_close(kl_divergence(loc_old, scale_old, loc, scale), expected)


def test_is_zero_for_the_same_policy_and_positive_otherwise():
    loc, scale = torch.randn(5, 3), torch.rand(5, 3) + 0.1
    assert torch.equal(kl_divergence(loc, scale, loc, scale), torch.zeros(5))
    assert (kl_divergence(loc, scale, loc + 0.1, scale * 1.1) > 0).all()


def test_equals_the_mean_log_ratio_of_samples():
    loc_old, scale_old = torch.tensor([0.5, -1.0]), torch.tensor([0.4, 1.5])
    loc, scale = torch.tensor([0.3, -0.5]), torch.tensor([0.5, 1.2])
    old, new = Independent(Normal(loc_old, scale_old), 1), Independent(Normal(loc, scale), 1)
    samples = old.sample((200_000,))
    estimate = (old.log_prob(samples) - new.log_prob(samples)).mean()
    assert kl_divergence(loc_old, scale_old, loc, scale).item() == pytest.approx(
        estimate.item(), rel=0.03
    )


def test_parameters_are_found_beneath_wrappers_and_nowhere_else():
    loc, scale = torch.randn(4, 3), torch.rand(4, 3) + 0.1
    for dist in (Normal(loc, scale), Independent(Normal(loc, scale), 1), TanhNormal(loc, scale)):
        parameters = gaussian_parameters(dist)
        assert parameters is not None
        torch.testing.assert_close(parameters, (loc, scale))
    assert gaussian_parameters(Categorical(logits=loc)) is None
