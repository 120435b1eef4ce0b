"""The settings of proximal policy optimization."""

from dataclasses import dataclass
from typing import ClassVar

from ksim_rl.checks import check_choice, check_in_range
from ksim_rl.objectives.algorithm_cfg import AlgorithmCfg

ADVANTAGES = ("gae", "td_lambda", "vtrace")
SCHEDULES = ("adaptive", "fixed")
SYMMETRIES = ("none", "augment", "loss")
NORMALIZATIONS = ("dataset", "minibatch", "none")
PRECISIONS = ("float32", "bfloat16", "auto")
KERNELS = ("auto", "torch")


@dataclass(frozen=True, kw_only=True)
class PPOCfg(AlgorithmCfg):
    """Proximal policy optimization (Schulman et al., arXiv 1707.06347); the defaults suit legged locomotion.

    Attributes:
        num_epochs: passes over each dataset.
        advantage: "gae", "td_lambda" (lambda returns; the same numbers in the rollout of a collector), or "vtrace",
            whose weights follow the policy from epoch to epoch.
        gamma, lmbda: discount per step, and weight of longer returns in the advantage.
        rho_thresh, c_thresh: bounds of the probability ratios in V-trace; see `VTrace`.
        estimate_each_epoch: estimate advantages and value targets anew before each epoch, with the present networks,
            instead of once (Andrychowicz et al., arXiv 2006.05990, section 3.5). "vtrace" always does.
        clip_epsilon: the probability ratio is clipped to [1 - clip_epsilon, 1 + clip_epsilon].
        clip_value: radius of the value clipping; True takes `clip_epsilon`, False does not clip.
        entropy_coeff, critic_coeff: weights of the entropy bonus and of the value loss.
        normalize_advantage: over the whole "dataset", over each "minibatch", or "none".
        learning_rate: of Adam, at the start; within its bounds if the schedule is adaptive.
        schedule: "adaptive" changes it after each gradient step so that the divergence of the policy from the
            one that collected the data stays near `desired_kl`; "fixed" keeps it.
        desired_kl: in nats.
        learning_rate_min, learning_rate_max: bounds of the adaptive schedule.
        max_grad_norm: bound on the norm of the gradient; None does not clip.
        betas, adam_eps, weight_decay: of Adam.
        symmetry: "augment" adds the mirror image of each env state to its minibatch, "loss" adds the mirror loss, which
            is zero for a policy that acts in the mirror as its mirror image; "none" does neither.
        symmetry_coeff: weight of the mirror loss.
        max_skipped_steps: so many gradient steps in a row that are not finite end the run.
        precision: of what layers multiply in the gradient steps: "float32" (on CUDA as `trainer.matmul_precision`
            says), or "bfloat16", which has 8 significant bits and moves the gradient by about half a percent of its
            norm; "auto" is "bfloat16" on CUDA and "float32" elsewhere. Parameters, sums, losses and Adam are
            always float32.
        kernels: of a bfloat16 update: "auto" takes a few fused kernels where they fit device and networks, "torch"
            never does. They differ by the order of sums. The metric `update/fused` says which it is.
    """

    learns_on_sequences: ClassVar[bool] = True

    num_epochs: int = 5
    advantage: str = "gae"
    gamma: float = 0.99
    lmbda: float = 0.95
    rho_thresh: float = 1.0
    c_thresh: float = 1.0
    estimate_each_epoch: bool = False
    clip_epsilon: float = 0.2
    clip_value: bool | float = True
    entropy_coeff: float = 0.01
    critic_coeff: float = 1.0
    normalize_advantage: str = "dataset"
    learning_rate: float = 1e-3
    schedule: str = "adaptive"
    desired_kl: float = 0.01
    learning_rate_min: float = 1e-5
    learning_rate_max: float = 1e-2
    max_grad_norm: float | None = 1.0
    betas: tuple[float, float] = (0.9, 0.999)
    adam_eps: float = 1e-8
    weight_decay: float = 0.0
    symmetry: str = "none"
    symmetry_coeff: float = 1.0
    max_skipped_steps: int = 100
    precision: str = "float32"
    kernels: str = "auto"

    @property
    def estimates_each_epoch(self) -> bool:
        """Whether advantages are estimated anew before each epoch."""
        return self.estimate_each_epoch or self.advantage == "vtrace"

    def check_memory(self) -> None:
        """Refuse a symmetry, of which memories know nothing."""
        if self.symmetry != "none":
            raise ValueError(
                f"objective.symmetry={self.symmetry!r}: the state of a memory has no known mirror image; use none, or "
                "modules=mlp"
            )

    def __post_init__(self) -> None:
        """Refuse values out of range, naming the field."""
        object.__setattr__(self, "betas", tuple(self.betas))
        for field in ("num_epochs", "max_skipped_steps"):
            check_in_range(field, getattr(self, field), low=1)
            if not isinstance(getattr(self, field), int):
                raise ValueError(f"{field}={getattr(self, field)!r}: expected a whole number >= 1")
        for field in ("gamma", "lmbda"):
            check_in_range(field, getattr(self, field), low=0.0, high=1.0)
        for field in (
            "rho_thresh",
            "c_thresh",
            "clip_epsilon",
            "desired_kl",
            "learning_rate",
            "learning_rate_min",
            "learning_rate_max",
            "adam_eps",
        ):
            check_in_range(field, getattr(self, field), low=0.0, low_open=True)
        check_in_range("clip_epsilon", self.clip_epsilon, high=1.0)
        for field in ("entropy_coeff", "critic_coeff", "weight_decay", "symmetry_coeff"):
            check_in_range(field, getattr(self, field), low=0.0)
        if not isinstance(self.clip_value, bool):
            check_in_range("clip_value", self.clip_value, low=0.0)
        if self.max_grad_norm is not None:
            check_in_range("max_grad_norm", self.max_grad_norm, low=0.0, low_open=True)
        for index, beta in enumerate(self.betas):
            check_in_range(f"betas[{index}]", beta, low=0.0, high=1.0)
        if len(self.betas) != 2 or max(self.betas) >= 1.0:
            raise ValueError(f"betas={self.betas!r}: expected two numbers in [0, 1)")
        check_choice("advantage", self.advantage, ADVANTAGES)
        check_choice("symmetry", self.symmetry, SYMMETRIES)
        check_choice("normalize_advantage", self.normalize_advantage, NORMALIZATIONS)
        check_choice("precision", self.precision, PRECISIONS)
        check_choice("kernels", self.kernels, KERNELS)
        check_schedule(
            self.schedule, self.learning_rate, low=self.learning_rate_min, high=self.learning_rate_max
        )


def check_schedule(schedule: str, learning_rate: float, *, low: float, high: float) -> None:
    """Refuse a schedule of the learning rate that contradicts itself.

    Raises:
        ValueError: naming the field, its value and the bounds.
    """
    check_choice("schedule", schedule, SCHEDULES)
    if low > high:
        raise ValueError(f"learning_rate_min={low!r} exceeds learning_rate_max={high!r}")
    if schedule == "adaptive" and not low <= learning_rate <= high:
        # Its first change would be a jump to the bound, even upwards where it should become smaller.
        raise ValueError(
            f"learning_rate={learning_rate!r}: schedule=adaptive keeps it in [learning_rate_min, learning_rate_max] = "
            f"[{low!r}, {high!r}]; start inside, move the bound, or use schedule=fixed"
        )
