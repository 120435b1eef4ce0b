"""An iteration of behavior cloning draws recorded env states, and makes gradient steps on them."""

import copy
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Num
from tensordict import TensorDictBase, unravel_key
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
)
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.algorithms.bc.demonstration import Demonstration, read_demonstration
from ksim_rl.algorithms.gradient_steps import DatasetUpdate, in_columns
from ksim_rl.algorithms.ppo.wiring import build_networks
from ksim_rl.data import DatasetCfg
from ksim_rl.envs.signal_keys import signal_keys
from ksim_rl.modules import update_normalizers
from ksim_rl.modules.network import ObservationNormalizer
from ksim_rl.objectives import (
    DEMONSTRATION,
    GAE,
    VALUE_TARGET,
    BCAndValueLoss,
    BCCfg,
    BCLoss,
    observation_keys,
)
from ksim_rl.ranks.running_moments import RunningMoments, publish
from ksim_rl.trainers.algorithm import part_of
from ksim_rl.trainers.run_cfg import RunCfg

# Names of the logged means, by the names that `ppo_step` gives them.
LOGGED = {
    "loss_bc": "loss/bc",
    "loss_critic": "loss/critic",
    "grad_norm": "update/grad_norm",
}


def make_bc_update(cfg: RunCfg, env: EnvBase, resumed: object = None) -> "BCUpdate":
    """Build the behavior cloning of a run, which reads its folder again where it is resumed."""
    objective: Any = cfg.objective
    if cfg.modules.trunk is not None:
        raise ValueError(
            "modules.trunk: behavior cloning trains the policy alone on what was recorded: leave the trunk out"
        )
    actor, critic = build_networks(cfg, env)
    device = cfg.resolved_device()
    demonstration = read_demonstration(
        Path(objective.episodes),
        env,
        keys=[*observation_keys(actor), "action"],
        held_out=objective.held_out,
        device=device,
    )
    return BCUpdate(
        objective,
        actor=actor,
        critic=critic,
        demonstration=demonstration,
        data=part_of(cfg, "data", DatasetCfg),
        seed=cfg.seed,
        device=device,
        signals=signal_keys(env),
    )


class BCUpdate(DatasetUpdate):
    """Lets a policy learn the actions of a demonstration, as many env states at a time as a dataset has.

    The policy is any probabilistic module that is not recurrent. What it collects teaches the critic alone. The
    `shared` are the other arguments of `DatasetUpdate`.
    """

    def __init__(
        self,
        cfg: BCCfg,
        *,
        actor: ProbabilisticTensorDictSequential,
        critic: TensorDictModule,
        demonstration: Demonstration,
        **shared: Any,
    ) -> None:
        self.actor = actor
        self.critic = critic
        self.behavior: TensorDictModuleBase = actor
        self.demonstration = demonstration
        self.advantage = GAE(gamma=cfg.gamma, lmbda=cfg.lmbda, critic=critic)
        loss = BCAndValueLoss(BCLoss(actor, loss=cfg.loss), critic)
        networks = {"actor": actor, "critic": critic}
        super().__init__(cfg, loss=loss, networks=networks, logged=LOGGED, **shared)
        self._held_out_loss = torch.zeros((), device=self.device)
        # All that the policy ever learns from is known from the start, and read once.
        self._normalizers = _normalizers(actor)
        recorded = copy.deepcopy(actor)
        for fresh in _normalizers(recorded):
            fresh.load_state_dict(RunningMoments(fresh.dim).state_dict())
        update_normalizers(demonstration.learned_N, recorded)
        self._recorded = _normalizers(recorded)
        self._weigh_recording_()

    @property
    def rollout_keys(self) -> list[NestedKey]:
        """The leaves of an env state that an update reads."""
        valued = self.critic.in_keys
        following = [*(unravel_key(("next", key)) for key in valued), *self.signals.following]
        return list(dict.fromkeys([*observation_keys(self.actor), *valued, *following]))

    def metrics(self) -> dict[str, Num[Tensor, ""]]:
        """Return the measurements of the last update, each a tensor [] on the device; means are over the steps made.

        `loss/held_out` is the loss on env states of episodes that are not learned from, after the update.
        """
        found = super().metrics()
        if self.demonstration.held_out_N is not None:
            found = found | {"loss/held_out": self._held_out_loss}
        return found

    def _update(self) -> None:
        valued_ET = self.advantage(self.rollout_ET)
        valued_D = valued_ET.select(*self.critic.in_keys, VALUE_TARGET).reshape(-1)
        steps = []
        for _ in range(self.cfg.num_epochs):
            drawn_D = self._drawn(self.demonstration.learned_N)
            # Each row has an env state to act in, and one to value.
            self.dataset.extend(valued_D.copy().set(DEMONSTRATION, drawn_D))
            steps += self._epoch(self.loss)
        self._measure_(in_columns(steps))
        if self.demonstration.held_out_N is not None:
            with torch.no_grad():
                measured = self.loss.bc(self._drawn(self.demonstration.held_out_N))
            self._held_out_loss.copy_(measured["loss_bc"])
        # Only now, so that all gradient steps see the statistics that values were computed with.
        update_normalizers(self.rollout_ET, self.critic)
        # Once more: the statistics stay as they are, and weigh as much as the policy has learned from the recording.
        # Those of a short one would be swept away by the first rollouts of a run that goes on from here.
        self._weigh_recording_()

    def _weigh_recording_(self) -> None:
        """Let the recording count once more in the statistics of the policy's observations."""
        for normalizer, recorded in zip(self._normalizers, self._recorded, strict=True):
            normalizer.count_again(recorded)
        publish(self._normalizers)

    def _drawn(self, env_states_N: TensorDictBase) -> TensorDictBase:
        """Draw as many env states as a dataset has, uniformly, with replacement."""
        index_D = torch.randint(len(env_states_N), (self.num_env_states,), device=self.device)
        return env_states_N[index_D]


def _normalizers(actor: TensorDictModuleBase) -> list[ObservationNormalizer]:
    return [module for module in actor.modules() if isinstance(module, ObservationNormalizer)]
