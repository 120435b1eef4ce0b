"""An iteration of distillation labels a rollout and makes gradient steps on it; it is one CUDA graph on CUDA."""

from pathlib import Path
from typing import Any

import torch
from jaxtyping import Num
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.algorithms.distillation.teacher import Teacher, load_teacher, restored_teacher
from ksim_rl.algorithms.gradient_steps import DatasetUpdate, in_columns
from ksim_rl.algorithms.ppo.wiring import make_ppo_policy
from ksim_rl.data import DatasetCfg
from ksim_rl.device import state_tree
from ksim_rl.device.state_tree import State, branch
from ksim_rl.envs.signal_keys import signal_keys
from ksim_rl.modules import MixedPolicy, update_normalizers
from ksim_rl.objectives import (
    DistillationCfg,
    DistillationLoss,
    distribution_keys,
    observation_keys,
)
from ksim_rl.trainers.algorithm import part_of
from ksim_rl.trainers.run_cfg import RunCfg

# Names of the logged means, by the names that `ppo_step` gives them.
LOGGED = {
    "loss_distillation": "loss/distillation",
    "kl": "update/kl",
    "grad_norm": "update/grad_norm",
}


def make_distillation_update(
    cfg: RunCfg, env: EnvBase, resumed: State | None = None
) -> "DistillationUpdate":
    """Build the distillation of a run; the teacher is in `resumed`, or else the policy of `objective.teacher`."""
    objective: Any = cfg.objective
    data = part_of(cfg, "data", DatasetCfg)
    student = make_ppo_policy(cfg, env)
    # A resumed run has its teacher in the checkpoint: the teacher's folder may be gone.
    if resumed is None:
        teacher = load_teacher(Path(objective.teacher), env, cfg=cfg)
    else:
        teacher = restored_teacher(branch(resumed, "teacher"), env, cfg=cfg)
    return DistillationUpdate(
        objective,
        actor=student,
        teacher=teacher,
        data=data,
        seed=cfg.seed,
        device=cfg.resolved_device(),
        signals=signal_keys(env),
    )


class DistillationUpdate(DatasetUpdate):
    """Lets a student learn its teacher's actions, from one rollout at a time; see `DatasetUpdate`.

    The student is any probabilistic module; a recurrent one learns on sequences. The teacher's actions must be like
    the student's; its policy labels env states, and helps to collect where `teacher_share` says so. The `shared` are
    the other arguments of `DatasetUpdate`.
    """

    def __init__(
        self,
        cfg: DistillationCfg,
        *,
        actor: ProbabilisticTensorDictSequential,
        teacher: Teacher,
        **shared: Any,
    ) -> None:
        self.actor = actor
        self.teacher = teacher
        loss = DistillationLoss(actor, teacher.policy, loss=cfg.loss)
        super().__init__(cfg, loss=loss, networks={"actor": actor}, logged=LOGGED, **shared)
        self.teacher_share = torch.tensor(cfg.teacher_share, device=self.device)
        # A teacher that never acts need not run while data are collected.
        helps = cfg.teacher_share > 0.0
        self.behavior: TensorDictModuleBase = actor
        # Without the divergence nothing learns how far actions should scatter.
        if helps or cfg.loss == "mse":
            self.behavior = MixedPolicy(
                actor,
                teacher.policy if helps else None,
                share=self.teacher_share,
                teacher_keys=self._teacher_keys if helps else (),
                explores=cfg.loss == "kl",
            )
        self._action_error = torch.zeros((), device=self.device)

    @property
    def rollout_keys(self) -> list[NestedKey]:
        """The leaves of an env state that an update reads."""
        read = [*observation_keys(self.actor), *self._teacher_keys, *distribution_keys(self.actor)]
        return list(dict.fromkeys([*read, *self.signals.following]))

    def metrics(self) -> dict[str, Num[Tensor, ""]]:
        """Return the measurements of the last update, each a tensor [] on the device; means are over the steps made.

        `update/action_error` is how far the student was from the teacher in the rollout, before it learned from it: the
        root mean square over actions, in their unit.
        """
        return super().metrics() | {
            "update/action_error": self._action_error,
            "update/teacher_share": self.teacher_share,
        }

    @property
    def _teacher_keys(self) -> list[NestedKey]:
        return observation_keys(self.teacher.policy)

    def _update(self) -> None:
        # Labels once per rollout: the teacher does not change while the student learns.
        labelled_ET = self.loss.label(self.rollout_ET)
        self._action_error.copy_(self.loss.action_error(labelled_ET))
        self.dataset.extend(labelled_ET)
        epochs = [self._epoch(self.loss) for _ in range(self.cfg.num_epochs)]
        self._measure_(in_columns([step for epoch in epochs for step in epoch]))
        # In place: the behaviour policy reads the same tensor.
        self.teacher_share.mul_(self.cfg.teacher_share_decay)
        # Only now, so that all gradient steps see the statistics that the rollout's actions were drawn with.
        update_normalizers(self.rollout_ET, self.actor)

    def state_dict(self) -> state_tree.State:
        """Return student, teacher, optimizer, sampler and counters."""
        own = {"teacher": self.teacher.state_dict(), "teacher_share": self.teacher_share}
        return {**super().state_dict(), **own}

    def load_state_dict(self, state: State) -> None:
        """Continue where `state_dict` was taken; see `RolloutUpdate`."""
        super().load_state_dict(state)
        self.teacher.load_state_dict(branch(state, "teacher"))
        self.teacher_share.copy_(state_tree.tensor(state, "teacher_share"))
