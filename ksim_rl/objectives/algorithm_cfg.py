"""The settings of all algorithms begin here: what a run asks of them, and the fields of gradient steps."""

from dataclasses import dataclass
from typing import ClassVar, Self

from ksim_rl.checks import check_choice, check_count, check_in_range

SCHEDULES = ("adaptive", "fixed")


@dataclass(frozen=True, kw_only=True)
class AlgorithmCfg:
    """The settings of an algorithm: a run's `objective`. A subclass of a registered one inherits its algorithm.

    Attributes:
        learns_on_sequences: whether networks may have a memory.
    """

    learns_on_sequences: ClassVar[bool] = False

    @property
    def observation_groups(self) -> tuple[str, ...]:
        """The observation groups that it reads beside those of the networks."""
        return ()

    def check_memory(self) -> None:
        """Refuse settings that networks with a memory do not allow.

        Raises:
            ValueError: naming the field and its value.
        """

    def with_absolute_paths(self) -> Self:
        """Return the same settings with paths that lead to the same files from any folder."""
        return self


@dataclass(frozen=True, kw_only=True)
class GradientCfg(AlgorithmCfg):
    """What all algorithms of this package say about their gradient steps.

    Attributes:
        betas, adam_eps, weight_decay: of Adam, or AdamW off policy.
        max_grad_norm: bound on the norm of the gradient; None does not clip.
        max_skipped_steps: so many gradient steps in a row that are not finite end the run.
    """

    betas: tuple[float, float] = (0.9, 0.999)
    adam_eps: float = 1e-8
    weight_decay: float = 0.0
    max_grad_norm: float | None = None
    max_skipped_steps: int = 100

    def __post_init__(self) -> None:
        """Refuse values out of range, naming the field."""
        object.__setattr__(self, "betas", tuple(self.betas))
        check_count("max_skipped_steps", self.max_skipped_steps)
        check_in_range("adam_eps", self.adam_eps, low=0.0, low_open=True)
        check_in_range("weight_decay", self.weight_decay, low=0.0)
        if self.max_grad_norm is not None:
            check_in_range("max_grad_norm", self.max_grad_norm, low=0.0, low_open=True)
        if len(self.betas) != 2 or not all(0.0 <= beta < 1.0 for beta in self.betas):
            raise ValueError(f"betas={self.betas!r}: expected two numbers in [0, 1)")


@dataclass(frozen=True, kw_only=True)
class OnPolicyCfg(GradientCfg):
    """What the algorithms share that pass over each rollout some times, with one Adam.

    Attributes:
        num_epochs: passes over each rollout.
        learning_rate: of Adam, at the start; within its bounds if the schedule is adaptive.
        schedule: "adaptive" changes it after each gradient step so that the divergence of the policy from the
            one that collected the rollout stays near `desired_kl`; "fixed" keeps it.
        desired_kl: in nats.
        learning_rate_min, learning_rate_max: bounds of the adaptive schedule.
    """

    learns_on_sequences: ClassVar[bool] = True

    num_epochs: int = 1
    learning_rate: float = 1e-3
    schedule: str = "fixed"
    desired_kl: float = 0.01
    learning_rate_min: float = 1e-5
    learning_rate_max: float = 1e-2
    max_grad_norm: float | None = 1.0

    def __post_init__(self) -> None:
        """Refuse values out of range, and a schedule that contradicts itself."""
        super().__post_init__()
        check_count("num_epochs", self.num_epochs)
        for field in ("desired_kl", "learning_rate", "learning_rate_min", "learning_rate_max"):
            check_in_range(field, getattr(self, field), low=0.0, low_open=True)
        check_choice("schedule", self.schedule, SCHEDULES)
        low, high = self.learning_rate_min, self.learning_rate_max
        if low > high:
            raise ValueError(f"learning_rate_min={low!r} exceeds learning_rate_max={high!r}")
        if self.schedule == "adaptive" and not low <= self.learning_rate <= high:
            # Its first change would be a jump to the bound, even upwards where it should become smaller.
            raise ValueError(
                f"learning_rate={self.learning_rate!r}: schedule=adaptive keeps it in [learning_rate_min, "
                f"learning_rate_max] = [{low!r}, {high!r}]; start inside, move the bound, or use schedule=fixed"
            )
