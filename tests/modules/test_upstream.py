"""What modules uses of torch beyond its documents is still there; each failure names the thing that moved."""

import pytest

from ksim_rl.modules import upstream


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("fused_lstm_cell", "input_gates hidden_gates cx input_bias hidden_bias"),
        ("fused_lstm_cell_backward", "grad_hy grad_cy cx cy workspace has_bias"),
        ("fused_gru_cell", "input_gates hidden_gates hx input_bias hidden_bias"),
        ("fused_gru_cell_backward", "grad_hy workspace has_bias"),
    ],
)
def test_the_kernels_of_recurrent_cells_take_the_same_arguments(name, arguments):
    schema = getattr(upstream, name).default._schema
    assert " ".join(argument.name for argument in schema.arguments) == arguments, schema
