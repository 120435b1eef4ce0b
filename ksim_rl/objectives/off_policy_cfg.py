"""This module holds the settings of off-policy learning with SAC and TD3."""

from dataclasses import dataclass

from ksim_rl.checks import check_choice, check_count, check_in_range
from ksim_rl.objectives.algorithm_cfg import GradientCfg

VALUE_REDUCTIONS = ("min", "mean")


@dataclass(frozen=True, kw_only=True)
class OffPolicyCfg(GradientCfg):
    """What all off-policy objectives share.

    Attributes:
        gamma: discount per step.
        tau: share of the new weights in each update of the target networks.
        value_reduction: "min" learns from, and climbs, the lowest of the predicted values (clipped double Q-learning,
            Fujimoto et al., arXiv 1802.09477); "mean" lets each network learn from its own target and climbs the mean.
        policy_delay: gradient steps of the critics for each of the actor.
        critic_learning_rate, actor_learning_rate: of AdamW.
        autocast: run the networks in bfloat16, with float32 weights.
    """

    gamma: float = 0.99
    tau: float = 0.005
    value_reduction: str = "min"
    policy_delay: int = 1
    critic_learning_rate: float = 3e-4
    actor_learning_rate: float = 3e-4
    autocast: bool = False

    def __post_init__(self) -> None:
        """Refuse values out of range, naming the field."""
        super().__post_init__()
        check_count("policy_delay", self.policy_delay)
        check_in_range("gamma", self.gamma, low=0.0, high=1.0)
        check_in_range("tau", self.tau, low=0.0, high=1.0, low_open=True)
        for field in ("critic_learning_rate", "actor_learning_rate"):
            check_in_range(field, getattr(self, field), low=0.0, low_open=True)
        check_choice("value_reduction", self.value_reduction, VALUE_REDUCTIONS)


@dataclass(frozen=True, kw_only=True)
class SACCfg(OffPolicyCfg):
    """Soft actor-critic with a learned temperature (Haarnoja et al., arXiv 1801.01290 and 1812.05905).

    With critics of many atoms, large minibatches and many envs it is FastSAC (Seo et al., arXiv 2512.01996).

    Attributes:
        alpha_init: temperature at the start, in units of the return per nat.
        alpha_learning_rate: of the temperature's logarithm; 0 keeps `alpha_init`.
        target_entropy_per_action: entropy that the temperature aims at, in nats per action, of actions scaled to
            [-1, 1].
    """

    alpha_init: float = 1.0
    alpha_learning_rate: float = 3e-4
    target_entropy_per_action: float = -1.0

    def __post_init__(self) -> None:
        """Refuse values out of range, naming the field."""
        super().__post_init__()
        check_in_range("alpha_init", self.alpha_init, low=0.0, low_open=True)
        check_in_range("alpha_learning_rate", self.alpha_learning_rate, low=0.0)
        check_in_range("target_entropy_per_action", self.target_entropy_per_action)


@dataclass(frozen=True, kw_only=True)
class TD3Cfg(OffPolicyCfg):
    """Twin delayed deterministic policy gradients (Fujimoto et al., arXiv 1802.09477).

    Targets take the present policy, not a slow copy of it, as FastTD3 does (Seo et al., arXiv 2505.22642).

    Attributes:
        exploration_noise_min, exploration_noise_max: range of the standard deviation of the noise on the actions that
            are taken, one per env, in units of half the range of an action.
        target_noise, target_noise_clip: standard deviation and bound of the noise on the actions that targets are
            computed for, in the same units.
    """

    policy_delay: int = 2
    exploration_noise_min: float = 0.1
    exploration_noise_max: float = 0.1
    target_noise: float = 0.2
    target_noise_clip: float = 0.5

    def __post_init__(self) -> None:
        """Refuse values out of range, naming the field."""
        super().__post_init__()
        for field in ("exploration_noise_min", "target_noise", "target_noise_clip"):
            check_in_range(field, getattr(self, field), low=0.0)
        check_in_range("exploration_noise_max", self.exploration_noise_max, low=self.exploration_noise_min)
