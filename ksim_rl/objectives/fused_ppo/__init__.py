"""The gradient steps of PPO as a few Triton kernels; `fused_ppo` itself is imported only where Triton is."""

from ksim_rl.objectives.fused_ppo.layout import (
    ACTIVATIONS,
    FusedLayout,
    FusedNetworks,
    Tuning,
    why_not_fused,
)

__all__ = ["ACTIVATIONS", "FusedLayout", "FusedNetworks", "Tuning", "why_not_fused"]
