"""The gradient steps of PPO as a few Triton kernels; `fused_ppo` itself is imported only where Triton is."""

from ksim_rl.objectives.fused_ppo.layout import FusedLayout, FusedNetworks
from ksim_rl.objectives.fused_ppo.limits import why_not_fused
from ksim_rl.objectives.fused_ppo.tuning import Tuning

__all__ = ["FusedLayout", "FusedNetworks", "Tuning", "why_not_fused"]
