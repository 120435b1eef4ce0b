"""Undocumented interfaces of torch and tensordict that `modules` uses.

`tests/modules/test_upstream.py` names the part that a new version moved.
"""

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor

_ATEN = torch.ops.aten

# The kernels behind torch.nn.LSTMCell and torch.nn.GRUCell, which exist on CUDA alone: one pointwise kernel for all
# gates of a step. The cells themselves hide the activated gates, and cuDNN's layers cannot reset single rows between
# two steps. Checked with torch 2.10 to 2.14.
fused_lstm_cell = _ATEN._thnn_fused_lstm_cell
fused_lstm_cell_backward = _ATEN._thnn_fused_lstm_cell_backward_impl
fused_gru_cell = _ATEN._thnn_fused_gru_cell
fused_gru_cell_backward = _ATEN._thnn_fused_gru_cell_backward


class TensorModule(TensorDictModule):
    """A `TensorDictModule` of tensors; the one of tensordict 0.14 imports pandas to look for data frames."""

    def _write_to_tensordict(
        self,
        tensordict: TensorDictBase,
        tensors: Sequence[Tensor],
        tensordict_out: TensorDictBase | None = None,
        out_keys: Sequence[NestedKey] | None = None,
    ) -> TensorDictBase:
        assert self.inplace is True, "networks write into what they read"
        if tensordict_out is None:
            into = tensordict
        else:
            into = tensordict_out
        for key, tensor in zip(
            self.out_keys_source if out_keys is None else out_keys, tensors, strict=True
        ):
            into.set(key, tensor)
        return into
