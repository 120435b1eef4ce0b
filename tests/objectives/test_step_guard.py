import pytest
import torch

from ksim_rl.objectives import StepGuard, clip_and_guard
from ksim_rl.testing import count_syncs


def _parameters(*gradients):
    parameters = []
    for gradient in gradients:
        parameters.append(torch.nn.Parameter(torch.zeros_like(gradient)))
        parameters[-1].grad = gradient.clone()
    return parameters


@pytest.mark.parametrize("max_grad_norm", [0.5, 1e6])
def test_clips_as_torch_does(max_grad_norm):
    gradients = (torch.randn(4, 3), torch.randn(5))
    ours, reference = _parameters(*gradients), _parameters(*gradients)
    norm, found_inf = clip_and_guard(ours, max_grad_norm)
    expected = torch.nn.utils.clip_grad_norm_(reference, max_grad_norm)
    torch.testing.assert_close(norm, expected)
    assert found_inf.item() == 0.0
    for one, other in zip(ours, reference, strict=True):
        torch.testing.assert_close(one.grad, other.grad)


def test_none_does_not_clip_and_parameters_without_gradient_are_left_out():
    gradient = torch.randn(5) * 100
    parameters = [*_parameters(gradient), torch.nn.Parameter(torch.zeros(2))]
    norm, found_inf = clip_and_guard(parameters, None)
    assert torch.equal(parameters[0].grad, gradient)
    assert norm.item() == pytest.approx(gradient.norm().item())
    assert found_inf.item() == 0.0


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_finds_what_is_not_finite(bad):
    gradient = torch.randn(5)
    assert clip_and_guard(_parameters(gradient), 1.0, loss=torch.tensor(bad))[1].item() == 1.0
    gradient[2] = bad
    assert clip_and_guard(_parameters(torch.randn(3), gradient), 1.0)[1].item() == 1.0


@pytest.mark.parametrize("capturable", [False, True])
def test_fused_adam_skips_the_step_and_continues_as_if_it_had_not_been(capturable):
    if capturable and not torch.cuda.is_available():
        capturable = False

    def run(steps):
        torch.manual_seed(0)
        layer = torch.nn.Linear(4, 3)
        optimizer = torch.optim.Adam(
            layer.parameters(), lr=torch.tensor(0.1), fused=True, capturable=capturable
        )
        for bad in steps:
            for parameter in layer.parameters():
                parameter.grad = torch.ones_like(parameter) * (float("nan") if bad else 0.3)
            optimizer.grad_scale, optimizer.found_inf = (
                None,
                clip_and_guard(layer.parameters(), 1.0)[1],
            )
            optimizer.step()
        return layer, optimizer

    layer, optimizer = run([False, True, True, False, True])
    expected, reference = run([False, False])
    for one, other in zip(layer.parameters(), expected.parameters(), strict=True):
        assert torch.equal(one, other)
    for one, other in zip(optimizer.state.values(), reference.state.values(), strict=True):
        for name in ("step", "exp_avg", "exp_avg_sq"):
            assert torch.equal(one[name], other[name]), name


def test_counts_in_total_and_in_a_row():
    guard = StepGuard()
    seen = []
    for found_inf in (0.0, 1.0, 1.0, 0.0, 1.0):
        guard.count_(torch.tensor(found_inf))
        seen.append((int(guard.skipped), int(guard.skipped_in_a_row)))
    assert seen == [(0, 0), (1, 1), (2, 2), (2, 0), (3, 1)]
    twin = StepGuard()
    twin.load_state_dict(guard.state_dict())
    assert int(twin.skipped) == 3


def test_no_host_sync():
    parameters, guard = _parameters(torch.randn(4, 3), torch.randn(5)), StepGuard()
    with count_syncs() as syncs:
        guard.count_(clip_and_guard(parameters, 1.0, loss=parameters[0].sum().detach())[1])
    assert syncs.total == 0, syncs.report()
