"""This module has the policy that collects while a student learns from a teacher: either acts, by chance."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type


class MixedPolicy(TensorDictModuleBase):
    """Lets the teacher act with a chance of `share` in each env state, and the student otherwise.

    That is the policy that DAgger collects with (Ross et al., arXiv 1011.0686, algorithm 3.1). All but the action is
    what the student writes. Draws come from torch's default generator; nothing here makes a host sync.

    Args:
        student: writes "action" and what training needs.
        teacher: acts deterministically, on its own observations; None leaves all to the student.
        teacher_keys: what the teacher reads.
        share: [], in [0, 1], on the device; it stays where it is and may change in place.
        explores: whether the student samples its actions, where TorchRL's exploration type says so; False takes those
            that it finds best.
    """

    share: Tensor

    def __init__(
        self,
        student: TensorDictModuleBase,
        teacher: TensorDictModuleBase | None = None,
        *,
        share: Float[Tensor, ""],
        teacher_keys: Sequence[Any] = (),
        explores: bool = True,
    ) -> None:
        super().__init__()
        self.student, self.teacher, self.explores = student, teacher, explores
        self._teacher_keys = list(teacher_keys)
        self.in_keys: Any = list(dict.fromkeys((*student.in_keys, *self._teacher_keys)))
        self.out_keys: Any = list(student.out_keys)
        self.register_buffer("share", share)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write "action" [E, action_dim], and beside it what the student writes."""
        seen = tensordict.select(*self._teacher_keys)
        with set_exploration_type(exploration_type() if self.explores else ExplorationType.DETERMINISTIC):
            acted = self.student(tensordict)
        if self.teacher is None:
            return acted
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            shown = self.teacher(seen).get("action")
        action = acted.get("action")
        helped_E = torch.rand(acted.batch_size, device=action.device) < self.share
        helped = helped_E.reshape(*acted.batch_size, *[1] * (action.ndim - acted.batch_dims))
        return acted.set("action", torch.where(helped, shown, action))
