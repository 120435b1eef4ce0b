"""The fixtures that tests of algorithms share."""

import pytest


@pytest.fixture(scope="module")
def fused_ppo():
    # tests/conftest.py turns the interpreter on where there is no CUDA.
    pytest.importorskip("triton", reason="Triton is not installed")
    from ksim_rl.objectives.fused_ppo.fused_ppo import FusedPPO

    return FusedPPO
