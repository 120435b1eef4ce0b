"""This module holds what `modules` uses of torch beyond its documented interfaces.

`tests/modules/test_upstream.py` names the part that a new version moved.
"""

import torch

_ATEN = torch.ops.aten

# The kernels behind torch.nn.LSTMCell and torch.nn.GRUCell, which exist on CUDA alone: one pointwise kernel for all
# gates of a step. The cells themselves hide the activated gates, and cuDNN's layers cannot reset single rows between
# two steps. Checked with torch 2.10 to 2.13.
fused_lstm_cell = _ATEN._thnn_fused_lstm_cell
fused_lstm_cell_backward = _ATEN._thnn_fused_lstm_cell_backward_impl
fused_gru_cell = _ATEN._thnn_fused_gru_cell
fused_gru_cell_backward = _ATEN._thnn_fused_gru_cell_backward
