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
from ksim_rl.algorithms.off_policy.wiring import make_squashed_policy
from ksim_rl.algorithms.ppo.wiring import build_networks, make_ppo_policy
from ksim_rl.data import DatasetCfg
from ksim_rl.envs.signal_keys import signal_keys
from ksim_rl.modules import SquashedActorCfg, update_normalizers
from ksim_rl.modules.bounded_actors import BoundedActor
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
    actor: Any
    critic = None
    if isinstance(cfg.modules.actor, SquashedActorCfg):
        actor = make_squashed_policy(cfg, env)
    else:
        actor, critic = build_networks(cfg, env)
    device = cfg.resolved_device()
    demonstration = read_demonstration(
        Path(objective.episodes),
        env,
        keys=[*observation_keys(actor), "action"],
        held_out=objective.held_out,
        device=device,
    )
    _check_within_bounds(actor, demonstration)
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


def make_bc_policy(cfg: RunCfg, env: EnvBase) -> TensorDictModuleBase:
    """Build the policy of a run: PPO's, or SAC's where `modules.actor` is of that kind."""
    if isinstance(cfg.modules.actor, SquashedActorCfg):
        return make_squashed_policy(cfg, env)
    return make_ppo_policy(cfg, env)


def _check_within_bounds(actor: TensorDictModuleBase, demonstration: Demonstration) -> None:
    """Refuse actions that a policy with bounds can never take, which would be learned as others."""
    for module in actor.modules():
        if not isinstance(module, BoundedActor):
            continue
        action_NL = demonstration.learned_N.get("action")
        # What is not finite is left out by the loss.
        outside_NL = (action_NL < module.low) | (action_NL > module.high)
        if outside_NL.any():
            farthest = action_NL[outside_NL].abs().max().item()
            raise ValueError(
                f"objective.episodes: actions reach {farthest:.3g}, and the policy stays within {module.low.tolist()} "
                f"and {module.high.tolist()}: record a policy with these bounds, or raise modules.actor.action_bound"
            )


class BCUpdate(DatasetUpdate):
    """Lets a policy learn the actions of a demonstration, as many env states at a time as a dataset has.

    The policy is any probabilistic module that is not recurrent. What it collects teaches the critic alone; without
    one it is only measured. The `shared` are the other arguments of `DatasetUpdate`.
    """

    def __init__(
        self,
        cfg: BCCfg,
        *,
        actor: ProbabilisticTensorDictSequential,
        critic: TensorDictModule | None,
        demonstration: Demonstration,
        **shared: Any,
    ) -> None:
        self.actor = actor
        self.critic = critic
        self.behavior: TensorDictModuleBase = actor
        self.demonstration = demonstration
        self.bc = BCLoss(actor, loss=cfg.loss)
        networks: dict[str, TensorDictModuleBase] = {"actor": actor}
        loss: BCLoss | BCAndValueLoss = self.bc
        if critic is not None:
            self.advantage = GAE(gamma=cfg.gamma, lmbda=cfg.lmbda, critic=critic)
            networks["critic"] = critic
            loss = BCAndValueLoss(self.bc, critic)
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
        valued: list[NestedKey] = []
        if self.critic is not None:
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
        valued_D = None
        if self.critic is not None:
            valued_ET = self.advantage(self.rollout_ET)
            valued_D = valued_ET.select(*self.critic.in_keys, VALUE_TARGET).reshape(-1)
        steps = []
        for _ in range(self.cfg.num_epochs):
            rows_D = self._drawn(self.demonstration.learned_N)
            if valued_D is not None:
                # Each row has an env state to act in, and one to value.
                rows_D = valued_D.copy().set(DEMONSTRATION, rows_D)
            self.dataset.extend(rows_D)
            steps += self._epoch(self.loss)
        self._measure_(in_columns(steps))
        if self.demonstration.held_out_N is not None:
            with torch.no_grad():
                measured = self.bc(self._drawn(self.demonstration.held_out_N))
            self._held_out_loss.copy_(measured["loss_bc"])
        # Only now, so that all gradient steps see the statistics that values were computed with.
        if self.critic is not None:
            update_normalizers(self.rollout_ET, self.critic)
        # Once more: the statistics stay as they are, and weigh as much as the policy has learned from the recording.
        # The first rollouts of a run that goes on from here would sweep away the statistics of a short recording.
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
