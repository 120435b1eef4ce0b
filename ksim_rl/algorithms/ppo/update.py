"""A PPO update estimates advantages, makes gradient steps and updates statistics; it is one CUDA graph on CUDA."""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Num
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor

from ksim_rl.algorithms.gradient_steps import DatasetUpdate, in_columns
from ksim_rl.algorithms.ppo.fused import FusedBehavior, NotFused, make_fused_ppo
from ksim_rl.device import state_tree
from ksim_rl.device.state_tree import State
from ksim_rl.modules import CarriedState, update_normalizers
from ksim_rl.objectives import (
    PPOCfg,
    distribution_keys,
    in_precision,
    make_advantage,
    make_loss,
    make_symmetric,
    observation_keys,
    with_precision_of,
)
from ksim_rl.transforms import MirrorMap

# Names of the logged means, by the names that `ppo_step` gives them.
LOGGED = {
    "loss_objective": "loss/policy",
    "loss_critic": "loss/value",
    "loss_mirror": "loss/mirror",
    "entropy": "loss/entropy",
    "kl": "update/kl",
    "clip_fraction": "update/clip_fraction",
    "explained_variance": "update/explained_variance",
    "grad_norm": "update/grad_norm",
}


class PPOUpdate(DatasetUpdate):
    """Improves actor and critic with one rollout at a time; see `DatasetUpdate`.

    The actor is any probabilistic module, which writes actions, their log-probabilities and parameters of the
    distribution; the critic writes `state_value`. For `cfg.symmetry`, `mirror` has the mirror images of their inputs
    and of the action. The `shared` are the other arguments of `DatasetUpdate`.
    """

    def __init__(
        self,
        cfg: PPOCfg,
        *,
        actor: ProbabilisticTensorDictSequential,
        critic: TensorDictModule,
        device: torch.device | str = "cpu",
        mirror: Mapping[NestedKey, MirrorMap] | None = None,
        **shared: Any,
    ) -> None:
        cfg = with_precision_of(cfg, device)
        self.actor = actor
        self.critic = critic
        self.advantage = make_advantage(cfg, actor, critic)
        loss = make_loss(cfg, actor, critic)
        networks = {"actor": actor, "critic": critic}
        super().__init__(cfg, loss=loss, networks=networks, device=device, logged=LOGGED, **shared)
        # Symmetry inside, precision outside: the mirrored half is computed in the same precision.
        losses = make_symmetric(cfg, loss, mirror, device=self.device)
        self._losses = in_precision(losses, cfg.precision, device=self.device)
        # The rollouts hold the recurrent states of the actor, and not of the critic.
        self._carried = CarriedState(critic, acting=actor)
        # The kernels that make the gradient steps, or why torch makes them.
        self.fused = make_fused_ppo(self, mirror)
        self._is_fused = torch.tensor(
            float(not isinstance(self.fused, NotFused)), device=self.device
        )
        self._std = torch.zeros((), device=self.device)
        self._scale_keys = [
            key for key in distribution_keys(actor) if key == "scale" or key[-1] == "scale"
        ]

    @property
    def behavior(self) -> ProbabilisticTensorDictSequential:
        """The policy that collects: the actor, with means as chained kernels compute them where they make the steps."""
        if isinstance(self.fused, NotFused) or not self.fused.layout.chained:
            return self.actor
        return FusedBehavior(self.actor, self.fused)

    @property
    def rollout_keys(self) -> list[NestedKey]:
        """The leaves of an env state that an update reads."""
        actor = self.actor
        written = [*actor.dist_sample_keys, *actor.log_prob_keys, *distribution_keys(actor)]
        # States of a recurrent critic are carried from update to update, and are in no rollout.
        valued = [key for key in self.critic.in_keys if key not in self._carried.keys]
        following = [*(unravel_key(("next", key)) for key in valued), *self.signals.following]
        return list(dict.fromkeys([*observation_keys(actor), *valued, *written, *following]))

    @property
    def notes(self) -> list[str]:
        """Why torch makes the gradient steps where there is a GPU, said at the start of a run."""
        if not isinstance(self.fused, NotFused) or self.device.type != "cuda":
            return []
        return [f"torch makes the gradient steps, not the fused kernels: {self.fused.reason}"]

    def metrics(self) -> dict[str, Num[Tensor, ""]]:
        """Return the measurements of the last update, each a tensor [] on the device; means are over the steps made."""
        if self._scale_keys:
            std = {"policy/std": self._std}
        else:
            std = {}
        return super().metrics() | std | {"update/fused": self._is_fused}

    def _update(self) -> None:
        rollout_ET = self.rollout_ET
        if isinstance(self.fused, NotFused):
            steps = self._torch_steps(rollout_ET)
            self._count()
            self._measure_(steps)
        else:
            # The kernels read the rollout themselves; of the dataset they need only the orders.
            orders_KD = self.dataset.epoch_orders(self.cfg.num_epochs)
            means, self._longest_skip, left_out = self.fused(rollout_ET, orders_KD, self._count)
            self._means.update({LOGGED[name]: own for name, own in means.items() if name in LOGGED})
            self.dataset.non_finite_count.add_(left_out)

    def _count(self) -> None:
        if self._scale_keys:
            # As `nanmean`, whose count copies all that it counts. The sign of NaN is zero.
            scales = [self.rollout_ET.get(key) for key in self._scale_keys]
            means = [own.nansum() / own.sign().sum() for own in scales]
            self._std.copy_(torch.stack(means).mean())
        # All gradient steps see the statistics that the rollout's actions were drawn with.
        update_normalizers(self.rollout_ET, self.actor, self.critic)

    def _torch_steps(self, rollout_ET: TensorDictBase) -> dict[str, Tensor]:
        """Make all gradient steps with torch; return their measurements, [steps]."""
        # The critic goes on from where it left the last rollout, and its states are stored with this one.
        self._carried.begin_(rollout_ET)
        rollout_ET = self.advantage(rollout_ET)
        self._carried.end_(rollout_ET)
        self.dataset.extend(rollout_ET)
        steps: list[dict[str, Tensor]] = []
        for epoch in range(self.cfg.num_epochs):
            if epoch > 0 and self.cfg.estimates_each_epoch:
                # The rows that are not finite were counted with the first estimate.
                count = self.dataset.non_finite_count.clone()
                self.dataset.extend(self.advantage(rollout_ET))
                self.dataset.non_finite_count.copy_(count)
            steps += self._epoch(self._losses)
        return in_columns(steps)

    def state_dict(self) -> state_tree.State:
        """Return networks, optimizer, sampler and counters."""
        return {**super().state_dict(), "recurrent_state": self._carried.state_dict()}

    def load_state_dict(self, state: State) -> None:
        """Continue where `state_dict` was taken; see `RolloutUpdate`."""
        super().load_state_dict(state)
        carried = state_tree.tensors(state_tree.branch(state, "recurrent_state"))
        self._carried.load_state_dict(carried, device=self.device)
