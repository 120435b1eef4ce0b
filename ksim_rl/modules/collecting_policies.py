"""Policies that collect: with noise for off-policy learning, or with a teacher's help."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Shaped
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type

from ksim_rl import ranks


class ExploringPolicy(TensorDictModuleBase):
    """Lets a policy act with noise on its actions, and before learning starts with random actions instead.

    Each env has its own scale of noise, drawn uniformly from [noise_min, noise_max], in units of half the range of an
    action, and drawn again at the end of an episode, so that one batch of envs explores both timidly and boldly (Seo et
    al., "FastTD3", arXiv 2505.22642). Zeros add none, for policies that draw their actions themselves. Draws come from
    torch's default generator; nothing here makes a host sync.
    """

    random: Tensor
    noise_scale_E1: Tensor

    def __init__(
        self,
        actor: TensorDictModuleBase,
        *,
        low_L: Float[Tensor, " L"],
        high_L: Float[Tensor, " L"],
        num_envs: int,
        noise_min: float = 0.0,
        noise_max: float = 0.0,
    ) -> None:
        super().__init__()
        self.actor = actor
        self.in_keys: list[NestedKey] = list(actor.in_keys)
        self.out_keys: list[NestedKey] = ["action"]
        self.noise_min = noise_min
        self.noise_max = noise_max
        self._low_L = low_L
        self._high_L = high_L
        # On the device, so that a captured step follows when learning starts.
        self.register_buffer("random", torch.ones((), dtype=torch.bool, device=low_L.device))
        self.register_buffer("noise_scale_E1", self._draw_scales(num_envs))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write "action" [E, action_dim]."""
        # A selection, so that only the action is written into the env's data.
        acting = self.actor(tensordict.select(*self.in_keys))
        action = acting.get("action")
        # Policies that draw their own actions, as SAC's, add no noise here.
        if self.noise_max > 0.0:
            half_range = (self._high_L - self._low_L) / 2
            noise = (
                ranks.randn(action.shape, device=action.device) * self.noise_scale_E1 * half_range
            )
            action = torch.maximum(torch.minimum(action + noise, self._high_L), self._low_L)
        # Uniform actions are drawn always: a branch on `random` would read it on the host.
        anything = self._low_L + ranks.rand(action.shape, device=action.device) * (
            self._high_L - self._low_L
        )
        return tensordict.set("action", torch.where(self.random, anything, action))

    @torch.no_grad()
    def end_episodes_(self, done_E: Bool[Tensor, " E"]) -> None:
        """Draw new scales of noise for the envs that `done_E` marks."""
        # Drawn for all envs, taken where an episode ends: no size depends on data.
        fresh_E1 = self._draw_scales(done_E.shape[0])
        self.noise_scale_E1.copy_(torch.where(done_E[:, None], fresh_E1, self.noise_scale_E1))

    def exploration_state(self) -> dict[str, Shaped[Tensor, "*?shape"]]:
        """Return this policy's own state, without its actor: tensors that `load` may copy into."""
        return {"random": self.random, "noise_scale": self.noise_scale_E1}

    def _draw_scales(self, num_envs: int) -> Tensor:
        unit_E1 = ranks.rand((num_envs, 1), device=self._low_L.device)
        return self.noise_min + (self.noise_max - self.noise_min) * unit_E1


class MixedPolicy(TensorDictModuleBase):
    """Lets the teacher act with a chance of `share` in each env state, and the student otherwise.

    That is the policy that DAgger collects with (Ross et al., arXiv 1011.0686, algorithm 3.1). All but the action is
    written by the student. The teacher reads `teacher_keys` and acts deterministically; None leaves all to the
    student. `share` may change in place. With `explores=False` the student takes the actions that it finds best. Draws
    come from torch's default generator; nothing here makes a host sync.
    """

    share: Tensor

    def __init__(
        self,
        student: TensorDictModuleBase,
        teacher: TensorDictModuleBase | None = None,
        *,
        share: Float[Tensor, ""],
        teacher_keys: Sequence[NestedKey] = (),
        explores: bool = True,
    ) -> None:
        super().__init__()
        self.student = student
        self.teacher = teacher
        self.explores = explores
        self._teacher_keys = list(teacher_keys)
        self.in_keys: list[NestedKey] = list(dict.fromkeys((*student.in_keys, *self._teacher_keys)))
        self.out_keys: list[NestedKey] = list(student.out_keys)
        self.register_buffer("share", share)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write "action" [E, action_dim], and all other outputs of the student."""
        # Before the student writes, which may change keys that the teacher reads.
        seen = tensordict.select(*self._teacher_keys)
        with set_exploration_type(
            exploration_type() if self.explores else ExplorationType.DETERMINISTIC
        ):
            acted = self.student(tensordict)
        if self.teacher is None:
            return acted
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            shown = self.teacher(seen).get("action")
        action = acted.get("action")
        helped_E = ranks.rand(acted.batch_size, device=action.device) < self.share
        # One draw per env state, for all dims of its action.
        helped = helped_E.reshape(*acted.batch_size, *[1] * (action.ndim - acted.batch_dims))
        return acted.set("action", torch.where(helped, shown, action))
