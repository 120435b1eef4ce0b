"""An iteration of distillation labels a rollout and makes gradient steps on it; it is one CUDA graph on CUDA."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Num
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.algorithms.distillation.teacher import Teacher, load_teacher, restored_teacher
from ksim_rl.algorithms.gradient_steps import (
    RolloutUpdate,
    StepMeans,
    epoch_of_steps,
    in_columns,
    make_dataset,
)
from ksim_rl.algorithms.optimizer_state import load_optimizer_state, optimizer_state
from ksim_rl.algorithms.ppo.wiring import make_ppo_policy
from ksim_rl.data import DatasetCfg
from ksim_rl.device import state_tree
from ksim_rl.modules import MixedPolicy, memories, update_normalizers
from ksim_rl.objectives import (
    DistillationCfg,
    DistillationLoss,
    distribution_keys,
    make_optimizer,
    observation_keys,
    observation_keys_of,
)
from ksim_rl.trainers.run_cfg import RunCfg

# Names of the logged means, by the names that `ppo_step` gives them.
LOGGED = {"loss_distillation": "loss/distillation", "kl": "update/kl", "grad_norm": "update/grad_norm"}


def make_distillation_update(
    cfg: RunCfg, env: EnvBase, resumed: Mapping[str, Any] | None = None
) -> "DistillationUpdate":
    """Build the distillation of a run; the teacher is in `resumed`, or else the policy of `objective.teacher`."""
    objective: Any = cfg.objective
    assert isinstance(objective, DistillationCfg)
    if not isinstance(cfg.data, DatasetCfg):
        raise ValueError(
            f"data is a {type(cfg.data).__name__}, and distillation needs a DatasetCfg: use data=on_policy"
        )
    student = make_ppo_policy(cfg, env)
    if resumed is None:
        teacher = load_teacher(Path(objective.teacher), env, cfg=cfg)
    else:
        teacher = restored_teacher(resumed["teacher"], env, cfg=cfg)
    return DistillationUpdate(
        objective, actor=student, teacher=teacher, data=cfg.data, seed=cfg.seed, device=cfg.resolved_device()
    )


class DistillationUpdate(RolloutUpdate):
    """Lets a student learn, from one rollout at a time, what its teacher would do there; see `RolloutUpdate`.

    Args:
        cfg: of the objective.
        actor: the student, any probabilistic module; with a memory it learns on sequences.
        teacher: whose policy labels env states.
        data: sizes of dataset and minibatch.
        seed: of the order of the env states in the minibatches.
        device: where all of it lives.

    Raises:
        ValueError: if the teacher's actions are not those of the student.
    """

    def __init__(
        self,
        cfg: DistillationCfg,
        *,
        actor: ProbabilisticTensorDictSequential,
        teacher: Teacher,
        data: DatasetCfg,
        seed: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__(max_skipped_steps=cfg.max_skipped_steps, device=device)
        self.cfg, self.actor, self.teacher = cfg, actor, teacher
        self.loss = DistillationLoss(actor, teacher.policy, loss=cfg.loss)
        self.optimizer = make_optimizer(cfg, actor)
        self._memories = memories(actor)
        self.dataset = make_dataset(
            data, keys=self.loss.dataset_keys, memories=self._memories, seed=seed, device=self.device
        )
        self.teacher_share = torch.tensor(cfg.teacher_share, device=self.device)
        helps = cfg.teacher_share > 0.0
        self._behavior: TensorDictModuleBase = actor
        # Without the divergence nothing learns how far actions should scatter.
        if helps or cfg.loss == "mse":
            self._behavior = MixedPolicy(
                actor,
                teacher.policy if helps else None,
                share=self.teacher_share,
                teacher_keys=self._teacher_keys if helps else (),
                explores=cfg.loss == "kl",
            )
        self._means = StepMeans(LOGGED)
        self._action_error = torch.zeros((), device=self.device)

    @property
    def behavior(self) -> TensorDictModuleBase:
        """The policy that collects: the student, with the teacher's help where `teacher_share` says so."""
        return self._behavior

    @property
    def num_env_states(self) -> int:
        """D, the env states of one rollout."""
        return self.dataset.cfg.num_env_states

    @property
    def rollout_keys(self) -> list[Any]:
        """The leaves of an env state that an update reads."""
        read = [*observation_keys(self.actor), *self._teacher_keys, *distribution_keys(self.actor)]
        return list(dict.fromkeys([*read, ("next", "reward")]))

    def metrics(self) -> dict[str, Num[Tensor, ""]]:
        """Return what the last update measured, each a tensor [] on the device; means are over the steps made.

        `update/action_error` is how far the student was from the teacher in the rollout, before it learned from it: the
        root mean square over actions, in their unit.
        """
        return (
            self._means
            | self._skipped()
            | {
                "update/action_error": self._action_error,
                "update/teacher_share": self.teacher_share,
                "update/learning_rate": self.optimizer.param_groups[0]["lr"],
                "update/non_finite_env_states": self.dataset.non_finite_count,
            }
        )

    @property
    def _teacher_keys(self) -> list[Any]:
        return observation_keys_of(self.teacher.policy)

    def _update(self) -> None:
        labelled_ET = self.loss.label(self.rollout_ET)
        self._action_error.copy_(self.loss.action_error(labelled_ET))
        self.dataset.extend(labelled_ET)
        made: list[dict[str, Tensor]] = []
        for _ in range(self.cfg.num_epochs):
            made += epoch_of_steps(
                self.dataset,
                self.loss,
                self.optimizer,
                cfg=self.cfg,
                guard=self.guard,
                memories=self._memories,
            )
        steps = in_columns(made)
        self._means.take_(steps)
        self._longest_skip.copy_(steps["skipped_in_a_row"].max())
        self.teacher_share.mul_(self.cfg.teacher_share_decay)
        # Only now, so that all gradient steps see the statistics that the rollout's actions were drawn with.
        update_normalizers(self.rollout_ET, self.actor)

    def state_dict(self) -> state_tree.State:
        """Return student, teacher, optimizer, sampler and counters."""
        return {
            "actor": self.actor.state_dict(),
            "teacher": self.teacher.state_dict(),
            "teacher_share": self.teacher_share,
            "optimizer": optimizer_state(self.optimizer),
            "sampler": self.dataset.sampler.state_dict(),
            "guard": self.guard.state_dict(),
            "non_finite_env_states": self.dataset.non_finite_count,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue where `state_dict` was taken; tensors keep their addresses.

        Raises:
            ValueError: naming the tensor that is missing, unknown or of another shape or type.
        """
        self.load_weights(state)
        self.teacher.load_state_dict(state["teacher"])
        load_optimizer_state(self.optimizer, state["optimizer"], what="optimizer")
        self.teacher_share.copy_(state["teacher_share"])
        self.dataset.sampler.load_state_dict(state["sampler"])
        state_tree.copy_into(self.guard.state_dict(), state["guard"], what="guard")
        self.dataset.non_finite_count.copy_(state["non_finite_env_states"])

    def load_weights(self, state: Mapping[str, Any]) -> None:
        """Take only the student of a `state_dict`.

        Raises:
            ValueError: naming the tensor that is missing, unknown or of another shape or type.
        """
        state_tree.copy_into(self.actor.state_dict(), state["actor"], what="actor")
