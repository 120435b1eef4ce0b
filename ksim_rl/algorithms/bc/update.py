"""An iteration of behavior cloning draws recorded env states, and makes gradient steps on them."""

from pathlib import Path
from typing import Any

import torch
from jaxtyping import Num
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.algorithms.bc.demonstration import Demonstration, read_demonstration
from ksim_rl.algorithms.gradient_steps import DatasetUpdate, in_columns
from ksim_rl.algorithms.ppo.wiring import make_ppo_policy
from ksim_rl.data import DatasetCfg
from ksim_rl.envs.signal_keys import signal_keys
from ksim_rl.modules import update_normalizers
from ksim_rl.objectives import BCCfg, BCLoss, observation_keys
from ksim_rl.trainers.algorithm import part_of
from ksim_rl.trainers.run_cfg import RunCfg

# Names of the logged means, by the names that `ppo_step` gives them.
LOGGED = {"loss_bc": "loss/bc", "grad_norm": "update/grad_norm"}


def make_bc_update(cfg: RunCfg, env: EnvBase, resumed: object = None) -> "BCUpdate":
    """Build the behavior cloning of a run, which reads its folder again where it is resumed."""
    objective: Any = cfg.objective
    actor = make_ppo_policy(cfg, env)
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
        demonstration=demonstration,
        data=part_of(cfg, "data", DatasetCfg),
        seed=cfg.seed,
        device=device,
        signals=signal_keys(env),
    )


class BCUpdate(DatasetUpdate):
    """Lets a policy learn the actions of a demonstration, as many env states at a time as a dataset has.

    The policy is any probabilistic module that is not recurrent. What it collects is not learned from. The `shared` are
    the other arguments of `DatasetUpdate`.
    """

    def __init__(
        self,
        cfg: BCCfg,
        *,
        actor: ProbabilisticTensorDictSequential,
        demonstration: Demonstration,
        **shared: Any,
    ) -> None:
        self.actor = actor
        self.behavior: TensorDictModuleBase = actor
        self.demonstration = demonstration
        loss = BCLoss(actor, loss=cfg.loss)
        super().__init__(cfg, loss=loss, networks={"actor": actor}, logged=LOGGED, **shared)
        self._held_out_loss = torch.zeros((), device=self.device)
        # All that is ever learned from is known from the start.
        update_normalizers(demonstration.learned_N, actor)

    @property
    def rollout_keys(self) -> list[NestedKey]:
        """The leaves of an env state that the metrics of a rollout need."""
        return list(dict.fromkeys([*observation_keys(self.actor), *self.signals.following]))

    def metrics(self) -> dict[str, Num[Tensor, ""]]:
        """Return the measurements of the last update, each a tensor [] on the device; means are over the steps made.

        `loss/held_out` is the loss on env states of episodes that are not learned from, after the update.
        """
        found = super().metrics()
        if self.demonstration.held_out_N is not None:
            found = found | {"loss/held_out": self._held_out_loss}
        return found

    def _update(self) -> None:
        steps = []
        for _ in range(self.cfg.num_epochs):
            self.dataset.extend(self._drawn(self.demonstration.learned_N))
            steps += self._epoch(self.loss)
        self._measure_(in_columns(steps))
        if self.demonstration.held_out_N is not None:
            with torch.no_grad():
                measured = self.loss(self._drawn(self.demonstration.held_out_N))
            self._held_out_loss.copy_(measured["loss_bc"])

    def _drawn(self, env_states_N: TensorDictBase) -> TensorDictBase:
        """Draw as many env states as a dataset has, uniformly, with replacement."""
        index_D = torch.randint(len(env_states_N), (self.num_env_states,), device=self.device)
        return env_states_N[index_D]
