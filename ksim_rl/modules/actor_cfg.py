"""The settings of a stochastic policy's network."""

from dataclasses import dataclass
from typing import Literal

from ksim_rl.checked import NonNegative, Positive
from ksim_rl.modules.network import NetworkCfg

MIN_STD = 1e-3


@dataclass(frozen=True, kw_only=True)
class ActorCfg(NetworkCfg):
    """The policy network.

    Attributes:
        distribution: of continuous actions: "gaussian", or within bounds "tanh_gaussian" or "truncated_gaussian".
            "categorical" where all actions are discrete; discrete ones among continuous ones always are.
        action_bound: the bounded distributions lie in [-action_bound, action_bound] where the env's action spec has no
            bounds; None refuses such a spec.
        init_std: standard deviation of each action at the start, in units of the action; of the bounded distributions
            in units of half the range, before the tanh or the truncation.
        min_std: lower bound of standard deviations, in units of `init_std`: how broadly it always explores.
        std_type: "scalar" learns the standard deviation itself, "log" its logarithm.
        state_dependent_std: predict the standard deviation from the state instead of learning one per action.
        output_gain: scale of the last layer's weights. Small, so that the first policy acts around zero (the default
            pose of a robot), or the center of the range, in every state.
    """

    distribution: Literal["gaussian", "tanh_gaussian", "truncated_gaussian", "categorical"] = (
        "gaussian"
    )
    action_bound: Positive | None = None
    init_std: Positive = 1.0
    min_std: Positive = MIN_STD
    std_type: Literal["scalar", "log"] = "scalar"
    state_dependent_std: bool = False
    output_gain: NonNegative = 0.01

    def _check_fields(self) -> None:
        """Refuse a bound that does nothing."""
        super()._check_fields()
        if self.action_bound is not None and self.distribution not in (
            "tanh_gaussian",
            "truncated_gaussian",
        ):
            raise ValueError(
                f"action_bound={self.action_bound!r} does nothing with distribution={self.distribution!r}: "
                "use 'tanh_gaussian' or 'truncated_gaussian', or leave it out"
            )
        # The floor would decide the first policy, whatever `init_std` says.
        if self.min_std > self.init_std:
            raise ValueError(
                f"min_std={self.min_std!r} exceeds init_std={self.init_std!r}: lower it, or begin there"
            )
