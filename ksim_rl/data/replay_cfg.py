"""This module has the sizes of off-policy data: how much is collected, kept, and drawn for gradient steps."""

from dataclasses import dataclass

from ksim_rl.checks import check_count, check_in_range


@dataclass(frozen=True, kw_only=True)
class ReplayCfg:
    """How many env states a rollout adds to the replay, how many it keeps, and how many a gradient step sees.

    One iteration is `num_steps` steps of each env and then `num_minibatches` gradient steps, so that there are
    `num_minibatches / num_steps` gradient steps per step. The recipe of FastTD3 alternates 1 step and u gradient steps;
    T steps and then T * u gradient steps is the same but for actions that are up to T - 1 steps older than the newest
    policy, and each iteration is only two graphs, whatever T is.

    Attributes:
        num_env_states_per_minibatch: B, env states in one gradient step.
        num_minibatches: gradient steps per iteration.
        num_steps: T, steps of each env per iteration.
        capacity: env states that are kept per env. An episode's end takes one more, for its terminal observation.
        n_step: rewards that a target sums before it bootstraps.
        learning_starts: steps of each env with random actions before the first gradient step.
        prioritized: draw env states by their last temporal-difference error (Schaul et al., arXiv 1511.05952) and not
            uniformly.
        priority_alpha: how strongly the error counts; 0 is uniform.
        priority_beta: how far the weights of the losses undo that; 1 is wholly.
        save_replay: keep the env states in checkpoints. Without, checkpoints are small and a resumed run begins with
            an empty replay and random actions until `learning_starts`, so that it is not the same run any more.
    """

    num_env_states_per_minibatch: int
    num_minibatches: int
    num_steps: int = 1
    capacity: int = 1024
    n_step: int = 1
    learning_starts: int = 10
    prioritized: bool = False
    priority_alpha: float = 0.6
    priority_beta: float = 0.4
    save_replay: bool = True

    def __post_init__(self) -> None:
        """Refuse sizes that are no positive whole numbers or do not fit each other, naming the field."""
        counts = ("num_env_states_per_minibatch", "num_minibatches", "num_steps", "capacity", "n_step")
        for field in (*counts, "learning_starts"):
            check_count(field, getattr(self, field))
        check_in_range("priority_alpha", self.priority_alpha, low=0.0)
        check_in_range("priority_beta", self.priority_beta, low=0.0, high=1.0)
        # A rollout whose episodes all end at once takes two places per env state, and must not overwrite itself.
        least = 2 * self.num_steps + self.n_step
        if self.capacity < least:
            raise ValueError(
                f"capacity={self.capacity} is less than 2 * num_steps + n_step = {least}: "
                "one rollout would overwrite itself; raise capacity"
            )

    def rollout_length(self, num_envs: int) -> int:
        """Return T, which does not depend on the number of envs."""
        return self.num_steps
