"""LSTM and GRU layers over a sequence whose state starts anew where an episode does.

cuDNN's kernels cannot zero the state of single rows between two steps, and splitting sequences at the resets makes
sizes that depend on data. Here the input projections of all steps come in as one product; each step is one recurrent
product and one pointwise kernel; and the backward pass forms the gradient of the recurrent weights in one product
over all steps. No size depends on data and nothing is read on the host, so it can be captured in a CUDA graph.
"""

from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

_aten = torch.ops.aten


def lstm_layer(
    gates_TB: Tensor, weight_hh: Tensor, state_B: tuple[Tensor, ...], reset_TB1: Tensor | None
) -> tuple[Tensor, ...]:
    """Run one LSTM layer (Hochreiter & Schmidhuber 1997, with forget gates; the formulas of `torch.nn.LSTM`).

    Args:
        gates_TB: W_ih x + b_ih + b_hh of each step, [T, B, 4H]: input, forget, cell, output.
        weight_hh: [4H, H].
        state_B: h and c before the first step, each [B, H].
        reset_TB1: bool [T, B, 1]: whether the state is zeroed before the step; None never does.

    Returns:
        h and c after each step, each [T, B, H].
    """
    return _LSTM.apply(gates_TB, weight_hh, *state_B, reset_TB1)  # type: ignore[no-any-return]


def gru_layer(
    gates_TB: Tensor,
    weight_hh: Tensor,
    bias_hh: Tensor,
    state_B: tuple[Tensor, ...],
    reset_TB1: Tensor | None,
) -> tuple[Tensor, ...]:
    """Run one GRU layer (Cho et al., arXiv 1406.1078, in the variant of `torch.nn.GRU`).

    Args:
        gates_TB: W_ih x + b_ih of each step, [T, B, 3H]: reset, update, new.
        weight_hh, bias_hh: [3H, H] and [3H].
        state_B: h before the first step, [B, H], as a tuple of one.
        reset_TB1: bool [T, B, 1]: whether the state is zeroed before the step; None never does.

    Returns:
        h after each step, [T, B, H], as a tuple of one.
    """
    return (_GRU.apply(gates_TB, weight_hh, bias_hh, *state_B, reset_TB1),)


class _LSTM(Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, gates_TB: Tensor, weight_hh: Tensor, h_B: Tensor, c_B: Tensor, reset_TB1: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        h0_B, c0_B = h_B, c_B
        steps: list[tuple[Tensor, Tensor, Tensor]] = []
        for t, gates_B in enumerate(gates_TB.unbind(0)):
            h_B, c_B = (_kept(state_B, reset_TB1, t) for state_B in (h_B, c_B))
            h_B, c_B, activations_B = _lstm_step(gates_B, h_B @ weight_hh.t(), c_B)
            steps.append((h_B, c_B, activations_B))
        h_TB, c_TB, activations_TB = (torch.stack(column) for column in zip(*steps, strict=True))
        ctx.save_for_backward(weight_hh, h0_B, c0_B, h_TB, c_TB, activations_TB, reset_TB1)
        ctx.set_materialize_grads(False)
        return h_TB, c_TB

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        grad_h_TB, grad_c_TB = grads
        weight_hh, h0_B, c0_B, h_TB, c_TB, activations_TB, reset_TB1 = ctx.saved_tensors
        c_before_TB = _before(c0_B, c_TB, reset_TB1)
        dh_B, dc_B = torch.zeros_like(h0_B), torch.zeros_like(c0_B)
        dgates_TB = torch.empty_like(activations_TB)
        for t in reversed(range(h_TB.shape[0])):
            dh_B = dh_B if grad_h_TB is None else dh_B + grad_h_TB[t]
            dc_B = dc_B if grad_c_TB is None else dc_B + grad_c_TB[t]
            dgates_B, dc_B = _lstm_step_backward(dh_B, dc_B, c_before_TB[t], c_TB[t], activations_TB[t])
            dgates_TB[t] = dgates_B
            dh_B, dc_B = (_kept(d_B, reset_TB1, t) for d_B in (dgates_B @ weight_hh, dc_B))
        h_before_TB = _before(h0_B, h_TB, reset_TB1)
        return dgates_TB, _outer(dgates_TB, h_before_TB), dh_B, dc_B, None


class _GRU(Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        gates_TB: Tensor,
        weight_hh: Tensor,
        bias_hh: Tensor,
        h_B: Tensor,
        reset_TB1: Tensor | None,
    ) -> Tensor:
        h0_B = h_B
        steps: list[tuple[Tensor, Tensor]] = []
        for t, gates_B in enumerate(gates_TB.unbind(0)):
            h_B = _kept(h_B, reset_TB1, t)
            h_B, workspace_B = _gru_step(gates_B, torch.addmm(bias_hh, h_B, weight_hh.t()), h_B)
            steps.append((h_B, workspace_B))
        h_TB, workspace_TB = (torch.stack(column) for column in zip(*steps, strict=True))
        ctx.save_for_backward(weight_hh, h0_B, h_TB, workspace_TB, reset_TB1)
        return h_TB

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (grad_h_TB,) = grads
        weight_hh, h0_B, h_TB, workspace_TB, reset_TB1 = ctx.saved_tensors
        dh_B = torch.zeros_like(h0_B)
        dinput: list[Tensor] = []
        drecurrent: list[Tensor] = []
        for t in reversed(range(h_TB.shape[0])):
            dinput_B, drecurrent_B, dh_B = _gru_step_backward(dh_B + grad_h_TB[t], workspace_TB[t])
            dinput.append(dinput_B)
            drecurrent.append(drecurrent_B)
            dh_B = _kept(torch.addmm(dh_B, drecurrent_B, weight_hh), reset_TB1, t)
        dinput_TB, drecurrent_TB = torch.stack(dinput[::-1]), torch.stack(drecurrent[::-1])
        dweight_hh = _outer(drecurrent_TB, _before(h0_B, h_TB, reset_TB1))
        return dinput_TB, dweight_hh, drecurrent_TB.sum((0, 1)), dh_B, None


def _kept(state_B: Tensor, reset_TB1: Tensor | None, t: int) -> Tensor:
    # A fill instead of a product: an old state that is NaN must not survive the reset.
    return state_B if reset_TB1 is None else state_B.masked_fill(reset_TB1[t], 0.0)


def _before(first_B: Tensor, after_TB: Tensor, reset_TB1: Tensor | None) -> Tensor:
    """Return the state that each step began with, from those that the steps ended with."""
    before_TB = torch.cat([first_B.unsqueeze(0), after_TB[:-1]])
    return before_TB if reset_TB1 is None else before_TB.masked_fill(reset_TB1, 0.0)


def _outer(left_TB: Tensor, right_TB: Tensor) -> Tensor:
    return left_TB.flatten(0, 1).t() @ right_TB.flatten(0, 1)


# On CUDA these are the fused kernels behind torch.nn.LSTMCell and torch.nn.GRUCell; they have none for the CPU.


def _lstm_step(gates_B: Tensor, recurrent_B: Tensor, c_B: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return h and c after the step, and the activated gates."""
    if gates_B.is_cuda:
        return _aten._thnn_fused_lstm_cell(gates_B, recurrent_B, c_B)
    i_B, f_B, g_B, o_B = (gates_B + recurrent_B).chunk(4, -1)
    i_B, f_B, g_B, o_B = i_B.sigmoid(), f_B.sigmoid(), g_B.tanh(), o_B.sigmoid()
    c_B = f_B * c_B + i_B * g_B
    return o_B * c_B.tanh(), c_B, torch.cat([i_B, f_B, g_B, o_B], -1)


def _lstm_step_backward(
    dh_B: Tensor, dc_B: Tensor, c_before_B: Tensor, c_B: Tensor, activations_B: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the gradients of the gates before activation, and of c before the step."""
    if dh_B.is_cuda:
        dgates_B, dc_B, _ = _aten._thnn_fused_lstm_cell_backward_impl(
            dh_B, dc_B, c_before_B, c_B, activations_B, False
        )
        return dgates_B, dc_B
    i_B, f_B, g_B, o_B = activations_B.chunk(4, -1)
    tanh_c_B = c_B.tanh()
    dc_B = dc_B + dh_B * o_B * (1.0 - tanh_c_B.square())
    dgates = [
        dc_B * g_B * i_B * (1.0 - i_B),
        dc_B * c_before_B * f_B * (1.0 - f_B),
        dc_B * i_B * (1.0 - g_B.square()),
        dh_B * tanh_c_B * o_B * (1.0 - o_B),
    ]
    return torch.cat(dgates, -1), dc_B * f_B


def _gru_step(gates_B: Tensor, recurrent_B: Tensor, h_B: Tensor) -> tuple[Tensor, Tensor]:
    """Return h after the step, and what the backward step needs."""
    if gates_B.is_cuda:
        return _aten._thnn_fused_gru_cell(gates_B, recurrent_B, h_B)
    (rx_B, zx_B, nx_B), (rh_B, zh_B, nh_B) = gates_B.chunk(3, -1), recurrent_B.chunk(3, -1)
    r_B, z_B = (rx_B + rh_B).sigmoid(), (zx_B + zh_B).sigmoid()
    n_B = (nx_B + r_B * nh_B).tanh()
    return n_B + z_B * (h_B - n_B), torch.cat([r_B, z_B, n_B, h_B, nh_B], -1)


def _gru_step_backward(dh_B: Tensor, workspace_B: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients of the input gates, the recurrent gates, and h itself."""
    if dh_B.is_cuda:
        return _aten._thnn_fused_gru_cell_backward(dh_B, workspace_B, False)[:3]
    r_B, z_B, n_B, h_B, nh_B = workspace_B.chunk(5, -1)
    dn_B = dh_B * (1.0 - z_B) * (1.0 - n_B.square())
    dz_B = dh_B * (h_B - n_B) * z_B * (1.0 - z_B)
    dr_B = dn_B * nh_B * r_B * (1.0 - r_B)
    return torch.cat([dr_B, dz_B, dn_B], -1), torch.cat([dr_B, dz_B, dn_B * r_B], -1), dh_B * z_B
