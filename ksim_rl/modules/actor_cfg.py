"""This module has the settings of a policy network."""

from dataclasses import dataclass

from ksim_rl.checks import check_choice, check_in_range
from ksim_rl.modules.network import OnPolicyNetworkCfg

STD_TYPES = ("scalar", "log")
DISTRIBUTIONS = ("gaussian", "tanh_gaussian", "truncated_gaussian", "categorical")


@dataclass(frozen=True, kw_only=True)
class ActorCfg(OnPolicyNetworkCfg):
    """The policy network.

    Attributes:
        distribution: of continuous actions: "gaussian", or within bounds "tanh_gaussian" or "truncated_gaussian".
            "categorical" where all actions are discrete; beside continuous ones, discrete ones always are.
        action_bound: the bounded distributions lie in [-action_bound, action_bound] where the env's action spec has no
            bounds; None refuses such a spec.
        init_std: standard deviation of each action at the start, in units of the action; of the bounded distributions
            in units of half the range, before the tanh or the truncation.
        std_type: "scalar" learns the standard deviation itself, "log" its logarithm.
        state_dependent_std: predict the standard deviation from the state instead of learning one per action.
        output_gain: scale of the last layer's weights. Small, so that the first policy acts around zero (the
            default pose of a robot), or the center of the range, in every state.
    """

    distribution: str = "gaussian"
    action_bound: float | None = None
    init_std: float = 1.0
    std_type: str = "scalar"
    state_dependent_std: bool = False
    output_gain: float = 0.01

    def __post_init__(self) -> None:
        """Refuse values out of range, naming the field."""
        super().__post_init__()
        check_choice("distribution", self.distribution, DISTRIBUTIONS)
        if self.action_bound is not None:
            check_in_range("action_bound", self.action_bound, low=0.0, low_open=True)
            if self.distribution not in ("tanh_gaussian", "truncated_gaussian"):
                raise ValueError(
                    f"action_bound={self.action_bound!r} does nothing with distribution={self.distribution!r}: "
                    "use 'tanh_gaussian' or 'truncated_gaussian', or leave it out"
                )
        check_in_range("init_std", self.init_std, low=0.0, low_open=True)
        check_choice("std_type", self.std_type, STD_TYPES)
        check_in_range("output_gain", self.output_gain, low=0.0)
