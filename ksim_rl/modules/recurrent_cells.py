"""LSTM and GRU layers over a sequence, whose state starts again with each episode.

cuDNN's kernels cannot zero the state of single rows between two steps, and splitting sequences at the resets makes
sizes that depend on data. Here the input projections of all steps come in as one product; each step is one recurrent
product and one pointwise kernel; and the backward pass forms the gradient of the recurrent weights in one product
over all steps. No size depends on data and nothing is read on the host, so it can be captured in a CUDA graph.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from ksim_rl.device.gradient_context import GradientContext
from ksim_rl.modules import upstream


class LSTM(Function):
    """One LSTM layer (Hochreiter & Schmidhuber 1997, with forget gates; the formulas of `torch.nn.LSTM`).

    `gates_TBG` is W_ih x + b_ih + b_hh of each step, G = 4 H: input, forget, cell, output. The state, h and c, is
    zeroed before the steps that `reset_TB1` marks.
    """

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: GradientContext,
        gates_TBG: Float[Tensor, "T B G"],
        weight_hh_GH: Float[Tensor, "G H"],
        h_BH: Float[Tensor, "B H"],
        c_BH: Float[Tensor, "B H"],
        reset_TB1: Bool[Tensor, "T B 1"] | None,
    ) -> tuple[Float[Tensor, "T B H"], ...]:
        """Return h and c after each step."""
        # The first state is kept: the backward pass needs the state before every step.
        h0_BH = h_BH
        c0_BH = c_BH
        steps: list[tuple[Tensor, Tensor, Tensor]] = []
        for t, gates_BG in enumerate(gates_TBG.unbind(0)):
            # The reset comes before the step: an episode begins with this step's input and no past.
            h_BH, c_BH = (_kept(state_BH, reset_TB1, t) for state_BH in (h_BH, c_BH))
            h_BH, c_BH, activations_BG = _lstm_step(gates_BG, h_BH @ weight_hh_GH.t(), c_BH)
            steps.append((h_BH, c_BH, activations_BG))
        h_TBH, c_TBH, activations_TBG = (torch.stack(column) for column in zip(*steps, strict=True))
        ctx.save_for_backward(weight_hh_GH, h0_BH, c0_BH, h_TBH, c_TBH, activations_TBG, reset_TB1)
        # Most losses read h only: the gradient of c then stays None instead of zeros.
        ctx.set_materialize_grads(False)
        return h_TBH, c_TBH

    @staticmethod
    @once_differentiable
    def backward(
        ctx: GradientContext,
        grad_h_TBH: Float[Tensor, "T B H"] | None,
        grad_c_TBH: Float[Tensor, "T B H"] | None,
    ) -> tuple[Float[Tensor, "*?weight"] | None, ...]:
        """Return the gradients."""
        weight_hh_GH, h0_BH, c0_BH, h_TBH, c_TBH, activations_TBG, reset_TB1 = ctx.saved_tensors
        c_before_TBH = _before(c0_BH, c_TBH, reset_TB1)
        dh_BH = torch.zeros_like(h0_BH)
        dc_BH = torch.zeros_like(c0_BH)
        dgates_TBG = torch.empty_like(activations_TBG)
        # Back through time: gradients from above join those from the step after.
        for t in reversed(range(h_TBH.shape[0])):
            if grad_h_TBH is not None:
                dh_BH = dh_BH + grad_h_TBH[t]
            if grad_c_TBH is not None:
                dc_BH = dc_BH + grad_c_TBH[t]
            dgates_BG, dc_BH = _lstm_step_backward(
                dh_BH, dc_BH, c_before_TBH[t], c_TBH[t], activations_TBG[t]
            )
            dgates_TBG[t] = dgates_BG
            # No gradient flows back over a reset, before which lies another episode.
            dh_BH, dc_BH = (_kept(d_BH, reset_TB1, t) for d_BH in (dgates_BG @ weight_hh_GH, dc_BH))
        # One product over all steps for the recurrent weights.
        h_before_TBH = _before(h0_BH, h_TBH, reset_TB1)
        return dgates_TBG, _outer(dgates_TBG, h_before_TBH), dh_BH, dc_BH, None


class GRU(Function):
    """One GRU layer (Cho et al., arXiv 1406.1078, in the variant of `torch.nn.GRU`).

    `gates_TBG` is W_ih x + b_ih of each step, G = 3 H: reset, update, new. The state h is zeroed before the steps that
    `reset_TB1` marks.
    """

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: GradientContext,
        gates_TBG: Float[Tensor, "T B G"],
        weight_hh_GH: Float[Tensor, "G H"],
        bias_hh_G: Float[Tensor, " G"],
        h_BH: Float[Tensor, "B H"],
        reset_TB1: Bool[Tensor, "T B 1"] | None,
    ) -> Float[Tensor, "T B H"]:
        """Return h after each step."""
        h0_BH = h_BH
        steps: list[tuple[Tensor, Tensor]] = []
        for t, gates_BG in enumerate(gates_TBG.unbind(0)):
            h_BH = _kept(h_BH, reset_TB1, t)
            h_BH, workspace_BG = _gru_step(
                gates_BG, torch.addmm(bias_hh_G, h_BH, weight_hh_GH.t()), h_BH
            )
            steps.append((h_BH, workspace_BG))
        h_TBH, workspace_TBG = (torch.stack(column) for column in zip(*steps, strict=True))
        ctx.save_for_backward(weight_hh_GH, h0_BH, h_TBH, workspace_TBG, reset_TB1)
        return h_TBH

    @staticmethod
    @once_differentiable
    def backward(
        ctx: GradientContext, grad_h_TBH: Float[Tensor, "T B H"]
    ) -> tuple[Float[Tensor, "*?weight"] | None, ...]:
        """Return the gradients."""
        weight_hh_GH, h0_BH, h_TBH, workspace_TBG, reset_TB1 = ctx.saved_tensors
        dh_BH = torch.zeros_like(h0_BH)
        dinput: list[Tensor] = []
        # Input and recurrent gates differ in the new gate, whose recurrent part the reset gate scales.
        drecurrent: list[Tensor] = []
        for t in reversed(range(h_TBH.shape[0])):
            dinput_BG, drecurrent_BG, dh_BH = _gru_step_backward(
                dh_BH + grad_h_TBH[t], workspace_TBG[t]
            )
            dinput.append(dinput_BG)
            drecurrent.append(drecurrent_BG)
            dh_BH = _kept(torch.addmm(dh_BH, drecurrent_BG, weight_hh_GH), reset_TB1, t)
        # Gathered from the last step to the first.
        dinput_TBG = torch.stack(dinput[::-1])
        drecurrent_TBG = torch.stack(drecurrent[::-1])
        dweight_hh_GH = _outer(drecurrent_TBG, _before(h0_BH, h_TBH, reset_TB1))
        return dinput_TBG, dweight_hh_GH, drecurrent_TBG.sum((0, 1)), dh_BH, None


def _kept(state_BH: Tensor, reset_TB1: Tensor | None, t: int) -> Tensor:
    # A fill instead of a product: an old state that is NaN must not survive the reset.
    if reset_TB1 is None:
        return state_BH
    return state_BH.masked_fill(reset_TB1[t], 0.0)


def _before(first_BH: Tensor, after_TBH: Tensor, reset_TB1: Tensor | None) -> Tensor:
    """Return the state that each step began with, from those that the steps ended with."""
    before_TBH = torch.cat([first_BH.unsqueeze(0), after_TBH[:-1]])
    if reset_TB1 is None:
        return before_TBH
    return before_TBH.masked_fill(reset_TB1, 0.0)


def _outer(left_TBH: Tensor, right_TBH: Tensor) -> Tensor:
    return left_TBH.flatten(0, 1).t() @ right_TBH.flatten(0, 1)


# On CUDA these are the fused kernels behind torch.nn.LSTMCell and torch.nn.GRUCell; they have none for the CPU.


def _lstm_step(
    gates_BG: Tensor, recurrent_BG: Tensor, c_BH: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return h and c after the step, and the activated gates."""
    if gates_BG.is_cuda:
        return upstream.fused_lstm_cell(gates_BG, recurrent_BG, c_BH)
    # The formulas of `torch.nn.LSTM`, for the CPU.
    i_BH, f_BH, g_BH, o_BH = (gates_BG + recurrent_BG).chunk(4, -1)
    i_BH = i_BH.sigmoid()
    f_BH = f_BH.sigmoid()
    g_BH = g_BH.tanh()
    o_BH = o_BH.sigmoid()
    c_BH = f_BH * c_BH + i_BH * g_BH
    return o_BH * c_BH.tanh(), c_BH, torch.cat([i_BH, f_BH, g_BH, o_BH], -1)


def _lstm_step_backward(
    dh_BH: Tensor, dc_BH: Tensor, c_before_BH: Tensor, c_BH: Tensor, activations_BG: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the gradients of the gates before activation, and of c before the step."""
    if dh_BH.is_cuda:
        dgates_BG, dc_BH, _ = upstream.fused_lstm_cell_backward(
            dh_BH, dc_BH, c_before_BH, c_BH, activations_BG, False
        )
        return dgates_BG, dc_BH
    i_BH, f_BH, g_BH, o_BH = activations_BG.chunk(4, -1)
    tanh_c_BH = c_BH.tanh()
    dc_BH = dc_BH + dh_BH * o_BH * (1.0 - tanh_c_BH.square())
    # Each by the derivative of its activation: s (1 - s) for sigmoids, 1 - t^2 for the tanh.
    dgates = [
        dc_BH * g_BH * i_BH * (1.0 - i_BH),
        dc_BH * c_before_BH * f_BH * (1.0 - f_BH),
        dc_BH * i_BH * (1.0 - g_BH.square()),
        dh_BH * tanh_c_BH * o_BH * (1.0 - o_BH),
    ]
    return torch.cat(dgates, -1), dc_BH * f_BH


def _gru_step(gates_BG: Tensor, recurrent_BG: Tensor, h_BH: Tensor) -> tuple[Tensor, Tensor]:
    """Return h after the step, and the workspace that the backward step reads."""
    if gates_BG.is_cuda:
        return upstream.fused_gru_cell(gates_BG, recurrent_BG, h_BH)
    # The formulas of `torch.nn.GRU`: the reset gate acts behind the recurrent product.
    rx_BH, zx_BH, nx_BH = gates_BG.chunk(3, -1)
    rh_BH, zh_BH, nh_BH = recurrent_BG.chunk(3, -1)
    r_BH = (rx_BH + rh_BH).sigmoid()
    z_BH = (zx_BH + zh_BH).sigmoid()
    n_BH = (nx_BH + r_BH * nh_BH).tanh()
    workspace = torch.cat([r_BH, z_BH, n_BH, h_BH, nh_BH], -1)
    return n_BH + z_BH * (h_BH - n_BH), workspace


def _gru_step_backward(dh_BH: Tensor, workspace_BG: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients of the input gates, the recurrent gates, and h itself."""
    if dh_BH.is_cuda:
        return upstream.fused_gru_cell_backward(dh_BH, workspace_BG, False)[:3]
    r_BH, z_BH, n_BH, h_BH, nh_BH = workspace_BG.chunk(5, -1)
    # Gradients before the activations of new, update and reset gate.
    dn_BH = dh_BH * (1.0 - z_BH) * (1.0 - n_BH.square())
    dz_BH = dh_BH * (h_BH - n_BH) * z_BH * (1.0 - z_BH)
    dr_BH = dn_BH * nh_BH * r_BH * (1.0 - r_BH)
    return (
        torch.cat([dr_BH, dz_BH, dn_BH], -1),
        torch.cat([dr_BH, dz_BH, dn_BH * r_BH], -1),
        dh_BH * z_BH,
    )
