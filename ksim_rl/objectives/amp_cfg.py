"""This module holds the settings of PPO with an adversarial motion prior."""

from dataclasses import dataclass

from ksim_rl.checks import check_count, check_in_range
from ksim_rl.objectives.ppo_cfg import PPOCfg


@dataclass(frozen=True, kw_only=True)
class AMPCfg(PPOCfg):
    """PPO on the task's reward and on a style reward, learned from reference motions (Peng et al., arXiv 2104.02180).

    A discriminator tells transitions of the motions from those of the policy; the style reward, in [0, 1] per step, is
    how much a transition looks like the motions. The sum `task_coeff * reward + style_coeff * style` is what PPO
    maximizes; where the env multiplies its rewards by the step's seconds, a fitting `style_coeff` is as small.

    Attributes:
        motions: reference motions, by name or file; the env sees their states in `style_group`.
        style_group: the observation group that is compared. Its terms read positions and velocities, no commands,
            actions, contacts or forces, which a motion does not have.
        task_coeff, style_coeff: weights of the two rewards.
        discriminator_hidden_dims, discriminator_activation: of the discriminator, an MLP.
        discriminator_learning_rate, discriminator_weight_decay: of its Adam, which has the betas of PPO's.
        gradient_penalty: weight of the squared norm of the discriminator's gradient at reference transitions.
        logit_decay: weight of the squares of its last layer's weights.
        num_discriminator_steps: gradient steps of the discriminator per rollout.
        num_transitions_per_step: of the motions, and as many of the policy, in one such step.
        replay_rollouts: the policy's transitions are drawn from so many of the last rollouts.
    """

    motions: tuple[str, ...] = ()
    style_group: str = "style"
    task_coeff: float = 0.5
    style_coeff: float = 0.5
    discriminator_hidden_dims: tuple[int, ...] = (512, 256)
    discriminator_activation: str = "relu"
    discriminator_learning_rate: float = 3e-4
    discriminator_weight_decay: float = 1e-4
    gradient_penalty: float = 10.0
    logit_decay: float = 0.05
    num_discriminator_steps: int = 10
    num_transitions_per_step: int = 4096
    replay_rollouts: int = 10

    @property
    def observation_groups(self) -> tuple[str, ...]:
        """The group that is compared."""
        return (self.style_group,)

    def __post_init__(self) -> None:
        """Refuse values out of range, naming the field."""
        super().__post_init__()
        for field in ("motions", "discriminator_hidden_dims"):
            object.__setattr__(self, field, tuple(getattr(self, field)))
        if not self.motions:
            raise ValueError("motions=(): name at least one reference motion, such as [walker_walk]")
        for field in (
            "task_coeff",
            "style_coeff",
            "discriminator_weight_decay",
            "gradient_penalty",
            "logit_decay",
        ):
            check_in_range(field, getattr(self, field), low=0.0)
        check_in_range(
            "discriminator_learning_rate", self.discriminator_learning_rate, low=0.0, low_open=True
        )
        for field, low in (
            ("num_discriminator_steps", 1),
            ("num_transitions_per_step", 1),
            # A rollout whose episodes all end at once takes two places per env state, and must not overwrite itself.
            ("replay_rollouts", 3),
        ):
            check_count(field, getattr(self, field), low=low)
