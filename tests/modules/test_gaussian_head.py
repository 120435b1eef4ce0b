import pytest
import torch

from ksim_rl.modules import ActorCfg
from ksim_rl.modules.action_heads import GaussianHead
from ksim_rl.modules.actor_cfg import MIN_STD


def _head(**kwargs):
    return GaussianHead(ActorCfg(**{"init_std": 0.7, "output_gain": 1.0, **kwargs}), 6, 3)


@pytest.mark.parametrize("state_dependent_std", [False, True])
@pytest.mark.parametrize("std_type", ["scalar", "log"])
def test_starts_at_init_std_in_every_state(std_type, state_dependent_std):
    loc, scale = _head(std_type=std_type, state_dependent_std=state_dependent_std)(
        torch.randn(5, 2, 6)
    )
    assert loc.shape == scale.shape == (5, 2, 3)
    torch.testing.assert_close(scale, torch.full((5, 2, 3), 0.7))


def test_scalar_parameter_is_the_std_and_log_its_logarithm():
    features = torch.randn(4, 6)
    scalar, log = _head(std_type="scalar"), _head(std_type="log")
    with torch.no_grad():
        scalar.std.copy_(torch.tensor([0.1, 0.2, 0.3]))
        log.std.copy_(torch.tensor([0.1, 0.2, 0.3]).log())
    torch.testing.assert_close(scalar(features)[1], torch.tensor([0.1, 0.2, 0.3]).expand(4, 3))
    torch.testing.assert_close(log(features)[1], torch.tensor([0.1, 0.2, 0.3]).expand(4, 3))


def test_state_dependent_std_depends_on_the_state_once_trained():
    head = _head(state_dependent_std=True)
    head(torch.randn(8, 6))[1].square().sum().backward()
    assert head.std_layer.weight.grad.abs().sum() > 0
    with torch.no_grad():
        head.std_layer.weight.normal_()
    assert head(torch.randn(8, 6))[1].std(0).min() > 0


@pytest.mark.parametrize("state_dependent_std", [False, True])
def test_autocast_rounds_what_it_reads_and_nothing_else(state_dependent_std):
    head, features = _head(state_dependent_std=state_dependent_std), torch.randn(64, 6).bfloat16()
    with torch.autocast("cpu", torch.bfloat16):
        rounded = head(features)
    torch.testing.assert_close(rounded, head(features.float()), rtol=0.0, atol=0.0)


@pytest.mark.parametrize("options", [{}, {"min_std": 0.2}], ids=str)
def test_std_is_bounded_below_and_comes_back(options):
    head = _head(**options)
    with torch.no_grad():
        head.std.fill_(-0.5)
    scale = head(torch.randn(4, 6))[1]
    torch.testing.assert_close(scale, torch.full((4, 3), options.get("min_std", MIN_STD)))
    scale.sum().backward()
    assert (head.std.grad > 0).all(), "a std below the bound must still get a gradient"


def test_refuses_a_bound_above_the_start():
    with pytest.raises(ValueError, match=r"min_std=0\.8 exceeds init_std=0\.7"):
        ActorCfg(init_std=0.7, min_std=0.8)
