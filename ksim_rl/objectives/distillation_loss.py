"""The loss that moves a student towards its teacher."""

from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    CompositeDistribution,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
)
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import set_recurrent_mode

from ksim_rl.checked import check_value
from ksim_rl.objectives.algorithm_cfg import DistillationKind
from ksim_rl.objectives.masked import mask_of, masked_mean
from ksim_rl.objectives.policy_kl import (
    distribution_keys,
    observation_keys,
    policy_kl,
    stored_distribution,
)
from ksim_rl.transforms.specs import path_of

TEACHER = "teacher"
"""Under this key a dataset holds the teacher's answer: its action and, for "kl", its distribution."""


class DistillationLoss(nn.Module):
    """`loss_distillation` = mean over env states of |a - a*|^2 / A, or of KL(teacher || student) in nats.

    a and a* are the actions that student and teacher take deterministically, A their number. Env states whose
    `("collector", "mask")` is False are left out. No value is read on the host. The teacher reads its own observations;
    a recurrent student learns on sequences `["B","T"]`. Raises ValueError with loss "kl" for a teacher without a
    distribution, and with "mse" for actions that are choices.
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        teacher: TensorDictModuleBase,
        *,
        loss: DistillationKind = "kl",
    ) -> None:
        super().__init__()
        check_value("loss", loss, DistillationKind)
        self.actor_network = actor_network
        # Not a submodule: its parameters are not the student's.
        self._teacher: Any = (teacher,)
        self.loss = loss
        self.label_keys: list[NestedKey] = ["action"]
        if loss == "kl":
            if not isinstance(teacher, ProbabilisticTensorDictSequential):
                raise ValueError(
                    "loss='kl': the teacher's policy has no distribution; use loss='mse'"
                )
            # The divergence needs the teacher's parameters; an action alone has no spread.
            self.label_keys += distribution_keys(teacher)
        self._has_choices = any(
            path_of(key)[-1] == "logits" for key in distribution_keys(actor_network)
        )
        if loss == "mse" and self._has_choices:
            raise ValueError(
                "loss='mse': the actions are choices, which have no distance; use loss='kl'"
            )

    @property
    def dataset_keys(self) -> list[NestedKey]:
        """The leaves that a dataset needs for this loss, labels included."""
        actor = self.actor_network
        labels = [(TEACHER, *path_of(key)) for key in self.label_keys]
        return list(dict.fromkeys([*observation_keys(actor), *distribution_keys(actor), *labels]))

    @torch.no_grad()
    def label(self, rollout_ET: TensorDictBase) -> TensorDictBase:
        """Return a rollout `["E","T"]` with the teacher's answer in each env state, under "teacher"."""
        (teacher,) = self._teacher
        seen_ET = rollout_ET.select(*observation_keys(teacher))
        # Labels are the teacher's intent, without the noise of its exploration.
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            judged_ET = teacher(seen_ET)
        # A shallow copy: the collector's buffers keep their keys.
        return rollout_ET.copy().set(TEACHER, judged_ET.select(*self.label_keys))

    @torch.no_grad()
    def action_error(self, labelled: TensorDictBase) -> Float[Tensor, ""]:
        """Return the root mean square of a - a* by the policy that collected the data, in units of the action."""
        behaved = stored_distribution(self.actor_network, labelled)
        if behaved is None or self._has_choices:
            # Choices have no distance, and some policies store no distribution.
            return torch.zeros((), device=labelled.device)
        return _action_error(behaved, labelled.get(TEACHER)).square().nanmean().sqrt()

    def forward(self, minibatch_B: TensorDictBase) -> TensorDictBase:
        """Return `loss_distillation`, and detached `kl`: how far the student moved since it collected, in nats.

        The minibatch, `["B"]` or `["B","T"]`, has the `dataset_keys`.
        """
        # The student writes its outputs into the copy, not into the minibatch.
        minibatch_B = minibatch_B.clone(False)
        # Read before the student runs, which overwrites the same keys.
        before = stored_distribution(self.actor_network, minibatch_B)
        with set_recurrent_mode(True):
            student = self.actor_network.get_dist(minibatch_B)
        labels_B = minibatch_B.get(TEACHER)
        if self.loss == "mse":
            loss_B = _action_error(student, labels_B).square().mean(-1)
        else:
            (teacher,) = self._teacher
            divergence_B = policy_kl(teacher.build_dist_from_params(labels_B), student)
            if divergence_B is None:
                raise ValueError(
                    "loss='kl': teacher and student have distributions of different kinds; use loss='mse'"
                )
            loss_B = divergence_B
        with torch.no_grad():
            # How far the student has moved since it collected; the adaptive learning rate follows it.
            if before is None:
                moved_B = None
            else:
                moved_B = policy_kl(before, student)
        mask_B = mask_of(minibatch_B, loss_B)
        mean = masked_mean(loss_B, mask_B)
        if moved_B is None:
            kl = torch.zeros_like(mean)
        else:
            kl = masked_mean(moved_B, mask_B)
        return TensorDict({"loss_distillation": mean, "kl": kl.detach()})


def _action_of(dist: Distribution) -> Tensor:
    """Return the action that a distribution stands for when nothing is explored."""
    return dist.deterministic_sample if hasattr(dist, "deterministic_sample") else dist.mean  # type: ignore[attr-defined]


def _action_error(dist: Distribution, labels: TensorDictBase) -> Tensor:
    """Return a - a*, [*batch, A]; parts of an action lie side by side."""
    if not isinstance(dist, CompositeDistribution):
        return _action_of(dist) - labels.get("action")
    errors = []
    for key, part in dist.dists.items():
        errors.append(_action_of(part) - labels.get(key))
    return torch.cat(errors, -1)
