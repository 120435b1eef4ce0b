"""The settings of all algorithms: of gradient steps, of PPO, AMP and distillation, of SAC and TD3."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

from ksim_rl.checked import (
    Checked,
    Count,
    Filled,
    NonNegative,
    Positive,
    Repeats,
    Share,
    WholeNumber,
    Within,
    numbers_of_layers,
)
from ksim_rl.checks import check_in_range

PositiveShare = Annotated[float, Within(low=0.0, high=1.0, low_open=True)]
Schedule = Literal["adaptive", "fixed"]
DistillationKind = Literal["kl", "mse"]
A_MOTION = "name at least one reference motion, such as [walker_walk]"
ValueReduction = Literal["min", "mean"]


@dataclass(frozen=True, kw_only=True)
class AlgorithmCfg(Checked):
    """The settings of an algorithm: a run's `objective`. A subclass of a registered one inherits its algorithm."""

    learns_on_sequences: ClassVar[bool] = False
    """Whether networks may be recurrent."""
    checkpoint_fields: ClassVar[tuple[str, ...]] = ()
    """The fields that name run folders or checkpoints."""
    episode_fields: ClassVar[tuple[str, ...]] = ()
    """The fields that name folders of episodes."""

    @property
    def observation_groups(self) -> tuple[str, ...]:
        """The observation groups that it reads in addition to the inputs of the networks."""
        return ()

    def check_recurrent(self) -> None:
        """Refuse settings that recurrent networks do not allow, by a ValueError."""

    def with_absolute_paths(self) -> Self:
        """Return the same settings with paths that lead to the same files from any folder."""
        return replace(
            self,
            **{
                name: str(Path(getattr(self, name)).resolve())
                for name in (*self.checkpoint_fields, *self.episode_fields)
            },
        )


@dataclass(frozen=True, kw_only=True)
class GradientCfg(AlgorithmCfg):
    """The settings of gradient steps that all algorithms share, by Adam, or AdamW off policy.

    Attributes:
        betas: decay of Adam's means of gradients and of their squares.
        adam_eps: the number that Adam adds to the root of the squares.
        weight_decay: share of the weights that a step takes away, times the learning rate.
        max_grad_norm: greatest norm of a gradient, to which longer ones are clipped; None does not clip.
        max_skipped_steps: so many steps in a row that are not finite end the run.
    """

    betas: tuple[float, float] = (0.9, 0.999)
    adam_eps: Positive = 1e-8
    weight_decay: NonNegative = 0.0
    max_grad_norm: Positive | None = None
    max_skipped_steps: Count = 100

    def _check_fields(self) -> None:
        super()._check_fields()
        # A config file gives lists; a frozen dataclass is hashable only with tuples.
        object.__setattr__(self, "betas", tuple(self.betas))
        if not all(0.0 <= beta < 1.0 for beta in self.betas):
            raise ValueError(f"betas={self.betas!r}: expected two numbers in [0, 1)")


@dataclass(frozen=True, kw_only=True)
class OnPolicyCfg(GradientCfg):
    """The settings of algorithms that pass over each rollout several times, with one Adam.

    Attributes:
        num_epochs: passes over each rollout.
        learning_rate: of Adam; where the adaptive schedule starts.
        schedule: "fixed", or "adaptive": the learning rate changes before each gradient step, within its bounds, so
            that the divergence of the policy from the one that collected the rollout stays near `desired_kl`.
        desired_kl: nats that the adaptive schedule aims at.
        learning_rate_min: lower bound of the adaptive schedule.
        learning_rate_max: upper bound of the adaptive schedule.
        anneal_learning_rate: multiply `learning_rate_max`, or the fixed rate, by the share of the run that is left.
    """

    learns_on_sequences = True

    max_grad_norm: Positive | None = 1.0
    num_epochs: Repeats = 1
    learning_rate: Positive = 1e-3
    schedule: Schedule = "fixed"
    desired_kl: Positive = 0.01
    learning_rate_min: Positive = 1e-5
    learning_rate_max: Positive = 1e-2
    anneal_learning_rate: bool = False

    def _check_fields(self) -> None:
        super()._check_fields()
        # The bounds must be in order before the first rate is compared with them.
        low = self.learning_rate_min
        high = self.learning_rate_max
        if low > high:
            raise ValueError(f"learning_rate_min={low!r} exceeds learning_rate_max={high!r}")
        if self.schedule == "adaptive" and not low <= self.learning_rate <= high:
            # Its first change would be a jump to the bound, even upwards where it should become smaller.
            raise ValueError(
                f"learning_rate={self.learning_rate!r}: schedule=adaptive keeps it in [learning_rate_min, "
                f"learning_rate_max] = [{low!r}, {high!r}]; start inside, move the bound, or use schedule=fixed"
            )


@dataclass(frozen=True, kw_only=True)
class PPOCfg(OnPolicyCfg):
    """Proximal policy optimization (Schulman et al., arXiv 1707.06347); the defaults suit legged locomotion.

    Attributes:
        advantage: "gae", "td_lambda" (lambda returns; the same numbers in the rollout of a collector), or "vtrace",
            whose weights follow the policy from epoch to epoch, within `rho_thresh` and `c_thresh`; see `VTrace`.
        value_lmbda: the lambda of value targets, where it is not `lmbda`: 1 makes them Monte Carlo returns, which end
            with the critic's value at the end of a rollout or at a time limit. "vtrace" has no such.
        gamma: discount of a step.
        lmbda: lambda of the advantages: 0 trusts the critic's next value, 1 the rewards.
        rho_thresh: upper bound of V-trace's weights of errors.
        c_thresh: upper bound of V-trace's weights of traces.
        clip_epsilon: how far the ratio of probabilities may move from 1 before it stops to count.
        entropy_coeff: weight of the policy's entropy in the loss.
        critic_coeff: weight of the critic's loss.
        normalize_advantage: over the "dataset", each "minibatch", or "none".
        symmetry_coeff: weight of the mirror loss, with `symmetry="loss"`.
        estimate_each_epoch: estimate advantages and value targets again before each epoch, with the present networks,
            instead of once (Andrychowicz et al., arXiv 2006.05990, section 3.5). "vtrace" always does.
        min_advantage_std: with `normalize_advantage="dataset"` advantages are divided by their standard deviation, at
            least this. Where no reward is seen they are errors of the critic, and soon shrink below any bound that
            fits the rewards: the policy stays as it is, where otherwise it would follow them and cease to explore.
        symmetry: "augment" adds the mirror image of each env state to its minibatch, "loss" adds `symmetry_coeff` times
            the mirror loss, which is zero for a policy that acts in the mirror as its mirror image.
        precision: of the products of layers in the gradient steps: "float32" (on CUDA as `trainer.matmul_precision`
            says), or "bfloat16", which has 8 significant bits and moves the gradient by about half a percent of its
            norm; "auto" is "bfloat16" on CUDA and "float32" elsewhere. All else is always float32.
        kernels: "auto" takes a few fused kernels for the gradient steps where they fit device, precision and networks,
            "torch" never does. They differ by the order of sums. The metric `update/fused` says which it is.
    """

    num_epochs: Repeats = 5
    schedule: Schedule = "adaptive"
    advantage: Literal["gae", "td_lambda", "vtrace"] = "gae"
    gamma: Share = 0.99
    lmbda: Share = 0.95
    value_lmbda: Share | None = None
    rho_thresh: Positive = 1.0
    c_thresh: Positive = 1.0
    estimate_each_epoch: bool = False
    clip_epsilon: PositiveShare = 0.2
    clip_value: bool | NonNegative = True  # radius of the value clipping; True takes `clip_epsilon`
    entropy_coeff: NonNegative = 0.01
    critic_coeff: NonNegative = 1.0
    normalize_advantage: Literal["dataset", "minibatch", "none"] = "dataset"
    min_advantage_std: Positive = 1e-4
    symmetry: Literal["none", "augment", "loss"] = "none"
    symmetry_coeff: NonNegative = 1.0
    precision: Literal["float32", "bfloat16", "auto"] = "float32"
    kernels: Literal["auto", "torch"] = "auto"

    def _check_fields(self) -> None:
        super()._check_fields()
        if self.value_lmbda is not None and self.advantage == "vtrace":
            raise ValueError(
                f"value_lmbda={self.value_lmbda!r} with advantage='vtrace', whose targets follow from the ratios of "
                "the policies: leave it out, or use advantage='gae'"
            )
        # A setting without effect is refused, so that no user relies on a floor that is not there.
        if (
            self.min_advantage_std != PPOCfg.min_advantage_std
            and self.normalize_advantage != "dataset"
        ):
            raise ValueError(
                f"min_advantage_std={self.min_advantage_std!r} does nothing with normalize_advantage="
                f"{self.normalize_advantage!r}: use 'dataset', or leave it out"
            )

    @property
    def estimates_each_epoch(self) -> bool:
        """Whether advantages are estimated again before each epoch."""
        return self.estimate_each_epoch or self.advantage == "vtrace"

    def check_recurrent(self) -> None:
        """Refuse a symmetry, which recurrent states do not support."""
        if self.symmetry != "none":
            raise ValueError(
                f"objective.symmetry={self.symmetry!r}: a recurrent state has no known mirror image; use none, or "
                "modules=mlp"
            )


@dataclass(frozen=True, kw_only=True)
class AMPCfg(PPOCfg):
    """PPO on the task's reward and on a style reward, learned from reference motions (Peng et al., arXiv 2104.02180).

    A discriminator tells transitions of the motions from the policy's; the style reward, in [0, 1] per step, is
    how much a transition looks like the motions. PPO maximizes the sum `task_coeff * reward + style_coeff * style`;
    where the env multiplies its rewards by the step's seconds, a fitting `style_coeff` is as small. The
    group `style_group` is compared: its terms read positions and velocities, no commands, actions, contacts or forces,
    which a motion does not have. A gradient step of the discriminator is on `num_transitions_per_step` of the motions
    and as many of the policy, from the last `replay_rollouts` rollouts.
    """

    motions: Annotated[tuple[str, ...], Filled(A_MOTION)] = ()  # by name or file
    style_group: str = "style"
    task_coeff: NonNegative = 0.5
    style_coeff: NonNegative = 0.5
    discriminator_hidden_dims: tuple[Count, ...] = (512, 256)
    discriminator_activation: str = "relu"
    discriminator_learning_rate: Positive = 3e-4
    discriminator_weight_decay: NonNegative = 1e-4
    gradient_penalty: NonNegative = 10.0  # of its squared gradient at reference transitions
    logit_decay: NonNegative = 0.05  # of the squares of its last layer's weights
    num_discriminator_steps: Repeats = 10  # per rollout
    num_transitions_per_step: Count = 4096
    # A rollout whose episodes all end at the same time takes two places per env state, and must not overwrite itself.
    replay_rollouts: Annotated[int, Within(low=3)] = 10

    @property
    def observation_groups(self) -> tuple[str, ...]:
        """The group that is compared."""
        return (self.style_group,)

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return what the discriminator needs, its transitions, and its replay of rollouts."""
        return {
            ("discriminator_hidden_dims",): numbers_of_layers(self.discriminator_hidden_dims),
            ("num_transitions_per_step",): 2 * self.num_transitions_per_step,
            ("replay_rollouts",): num_envs * self.replay_rollouts,
        }

    def data_files(self) -> Sequence[str]:
        """Return the names of the motions."""
        return self.motions

    def _check_fields(self) -> None:
        super()._check_fields()
        # As above: lists of a config file become tuples.
        for field in ("motions", "discriminator_hidden_dims"):
            object.__setattr__(self, field, tuple(getattr(self, field)))


@dataclass(frozen=True, kw_only=True)
class DistillationCfg(OnPolicyCfg):
    """A student learns to act as a teacher (a run folder or a checkpoint) does, in the states that the student visits.

    That is DAgger (Ross et al., arXiv 1011.0686) without its aggregate of all data: the newest rollout of thousands of
    envs stands for it. The loss "kl" is the divergence of the student's distribution from the teacher's, which also
    learns how actions scatter; "mse" compares the actions that both take deterministically, without noise while the
    student collects, for teachers without a distribution or with another kind of it. `teacher_share` is the chance that
    the teacher acts instead of the student, in each env state of the first rollout; it decays from rollout to rollout
    by a factor. With 0 a student that sees its own last action may drive it up without end before it has learned
    anything, and a normalizer never forgets such numbers.
    """

    num_epochs: Repeats = 2
    checkpoint_fields = ("teacher",)

    teacher: Annotated[str, Filled("name a run folder or a checkpoint, objective.teacher=RUN")] = ""
    loss: DistillationKind = "kl"
    teacher_share: Share = 1.0
    teacher_share_decay: Share = 0.95


@dataclass(frozen=True, kw_only=True)
class BCCfg(OnPolicyCfg):
    """A policy learns to act as the `episodes` of a folder do (behavior cloning), in the states that these visit.

    Gradient steps are on env states drawn from the folder, as many as a dataset has. The loss "nll" is TorchRL's
    negative log-likelihood of the recorded action, by which the policy also learns how much actions scatter; "mse" is
    the squared distance from it of the deterministic action, and leaves the scatter as it is. A share of the episodes
    is `held_out`: the loss on them is measured, and not learned.

    The critic learns, in the same steps, what the policy's own rollouts return, by GAE with `gamma` and `lmbda`. The
    policy learns nothing from them; PPO that goes on from here would spoil it with a critic that knows nothing.
    """

    learns_on_sequences = False
    episode_fields = ("episodes",)

    num_epochs: Repeats = 4
    episodes: Annotated[str, Filled("name a folder of episodes, objective.episodes=FOLDER")] = ""
    loss: Literal["nll", "mse"] = "nll"
    held_out: Annotated[float, Within(low=0.0, high=0.5)] = 0.1
    gamma: Share = 0.99  # discount of a step, as of the PPO that goes on
    lmbda: Share = 0.95  # of GAE

    def _check_fields(self) -> None:
        super()._check_fields()
        if self.schedule == "adaptive":
            raise ValueError(
                "schedule='adaptive' follows the divergence of a policy that collects, and here none does: use 'fixed'"
            )


@dataclass(frozen=True, kw_only=True)
class OffPolicyCfg(GradientCfg):
    """The settings that all off-policy objectives share, as learned by AdamW.

    `value_reduction="min"` learns from, and climbs, the lowest of the predicted values (clipped double Q-learning,
    Fujimoto et al., arXiv 1802.09477); with "mean" each network learns from its own target, and the mean is climbed.

    `compile` lets `torch.compile` fuse the kernels of the losses on CUDA: half the time of a gradient step, for most of
    a minute at the first one. `symmetry="augment"` mirrors every second env state, for robots that are their own image.
    """

    gamma: Share = 0.99  # discount of a step
    tau: PositiveShare = 0.005  # share of the new weights in each update of the target networks
    value_reduction: ValueReduction = "min"  # of the predictions of several critics
    policy_delay: Count = 1  # gradient steps of the critics for each of the actor
    critic_learning_rate: Positive = 3e-4  # of AdamW
    actor_learning_rate: Positive = 3e-4  # of AdamW
    autocast: bool = False  # run the networks in bfloat16, with float32 weights
    compile: bool = False  # fuse the kernels of the losses on CUDA
    symmetry: Literal["none", "augment"] = "none"  # "augment" mirrors every second env state
    random_shift: WholeNumber = (
        0  # pixels by which pictures in minibatches move at random, as in DrQ-v2
    )


@dataclass(frozen=True, kw_only=True)
class SACCfg(OffPolicyCfg):
    """Soft actor-critic with a learned temperature (Haarnoja et al., arXiv 1801.01290 and 1812.05905).

    With critics of many atoms, large minibatches and many envs it is FastSAC (Seo et al., arXiv 2512.01996). The
    temperature starts at `alpha_init`, in units of the return per nat, and stays there with `alpha_learning_rate=0`; it
    aims at an entropy of `target_entropy_per_action` nats, of actions scaled to [-1, 1].
    """

    alpha_init: Positive = 1.0  # the first temperature, return per nat
    alpha_learning_rate: NonNegative = 3e-4  # of the temperature; 0 keeps it
    target_entropy_per_action: float = -1.0  # nats that the temperature aims at


@dataclass(frozen=True, kw_only=True)
class TD3Cfg(OffPolicyCfg):
    """Twin delayed deterministic policy gradients (Fujimoto et al., arXiv 1802.09477).

    Targets take the present policy, not a slow copy of it, as FastTD3 does (Seo et al., arXiv 2505.22642). Each env has
    a standard deviation of the noise on its actions from [exploration_noise_min, exploration_noise_max]; the
    noise on the actions of targets has `target_noise`, clipped. All are in units of half the range of an action.
    """

    policy_delay: Count = 2
    exploration_noise_min: NonNegative = 0.1
    exploration_noise_max: float = 0.1
    target_noise: NonNegative = 0.2
    target_noise_clip: NonNegative = 0.5

    def _check_fields(self) -> None:
        super()._check_fields()
        check_in_range(
            "exploration_noise_max", self.exploration_noise_max, low=self.exploration_noise_min
        )
