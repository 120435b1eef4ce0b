"""This module holds the settings of proximal policy optimization."""

from dataclasses import dataclass

from ksim_rl.checks import check_choice, check_in_range
from ksim_rl.objectives.algorithm_cfg import OnPolicyCfg

ADVANTAGES = ("gae", "td_lambda", "vtrace")
SYMMETRIES = ("none", "augment", "loss")
NORMALIZATIONS = ("dataset", "minibatch", "none")
PRECISIONS = ("float32", "bfloat16", "auto")
KERNELS = ("auto", "torch")


@dataclass(frozen=True, kw_only=True)
class PPOCfg(OnPolicyCfg):
    """Proximal policy optimization (Schulman et al., arXiv 1707.06347); the defaults suit legged locomotion.

    Attributes:
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
        symmetry: "augment" adds the mirror image of each env state to its minibatch, "loss" adds the mirror loss, which
            is zero for a policy that acts in the mirror as its mirror image; "none" does neither.
        symmetry_coeff: weight of the mirror loss.
        precision: of what layers multiply in the gradient steps: "float32" (on CUDA as `trainer.matmul_precision`
            says), or "bfloat16", which has 8 significant bits and moves the gradient by about half a percent of its
            norm; "auto" is "bfloat16" on CUDA and "float32" elsewhere. Parameters, sums, losses and Adam are
            always float32.
        kernels: of a bfloat16 update: "auto" takes a few fused kernels where they fit device and networks, "torch"
            never does. They differ by the order of sums. The metric `update/fused` says which it is.
    """

    num_epochs: int = 5
    schedule: str = "adaptive"
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
    symmetry: str = "none"
    symmetry_coeff: float = 1.0
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
        super().__post_init__()
        for field in ("gamma", "lmbda"):
            check_in_range(field, getattr(self, field), low=0.0, high=1.0)
        for field in ("rho_thresh", "c_thresh", "clip_epsilon"):
            check_in_range(field, getattr(self, field), low=0.0, low_open=True)
        check_in_range("clip_epsilon", self.clip_epsilon, high=1.0)
        for field in ("entropy_coeff", "critic_coeff", "symmetry_coeff"):
            check_in_range(field, getattr(self, field), low=0.0)
        if not isinstance(self.clip_value, bool):
            check_in_range("clip_value", self.clip_value, low=0.0)
        check_choice("advantage", self.advantage, ADVANTAGES)
        check_choice("symmetry", self.symmetry, SYMMETRIES)
        check_choice("normalize_advantage", self.normalize_advantage, NORMALIZATIONS)
        check_choice("precision", self.precision, PRECISIONS)
        check_choice("kernels", self.kernels, KERNELS)
