"""The policy that collects while a teacher still helps its student."""

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type


class MixedPolicy(TensorDictModuleBase):
    """Lets the teacher act with a chance of `share` in each env state, and the student otherwise.

    That is the policy that DAgger collects with (Ross et al., arXiv 1011.0686, algorithm 3.1). All but the action is
    what the student writes. Draws come from torch's default generator; nothing here makes a host sync.

    Args:
        student: writes "action" and what training needs.
        teacher: acts deterministically, on its own observations.
        share: [], in [0, 1], on the device; it stays where it is and may change in place.
    """

    share: Tensor

    def __init__(
        self, student: TensorDictModuleBase, teacher: TensorDictModuleBase, *, teacher_keys: Any, share: Tensor
    ) -> None:
        super().__init__()
        self.student, self.teacher = student, teacher
        self._teacher_keys = list(teacher_keys)
        self.in_keys: Any = list(dict.fromkeys((*student.in_keys, *self._teacher_keys)))
        self.out_keys: Any = list(student.out_keys)
        self.register_buffer("share", share)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write "action" [E, action_dim], and beside it what the student writes."""
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            shown = self.teacher(tensordict.select(*self._teacher_keys)).get("action")
        acted = self.student(tensordict)
        action = acted.get("action")
        helped = torch.rand(acted.batch_size, device=action.device) < self.share
        helped = helped.reshape(*acted.batch_size, *[1] * (action.ndim - acted.batch_dims))
        return acted.set("action", torch.where(helped, shown, action))
