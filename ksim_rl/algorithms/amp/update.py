"""AMP scores a rollout's style, lets PPO learn from it, and teaches the discriminator; one CUDA graph on CUDA."""

import dataclasses
from typing import Any

import torch
from jaxtyping import Float32, Num
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl import ranks
from ksim_rl.algorithms.gradient_steps import (
    RolloutUpdate,
    in_columns,
    load_optimizer_state,
    optimizer_state,
)
from ksim_rl.algorithms.ppo.update import PPOUpdate
from ksim_rl.algorithms.ppo.wiring import make_ppo_update
from ksim_rl.data import MASK_KEY, ReplayCfg, ReplayRing
from ksim_rl.device import state_tree
from ksim_rl.device.state_tree import State, branch
from ksim_rl.envs.signal_keys import STANDARD
from ksim_rl.mdp.motion_observations import observe_motion
from ksim_rl.modules import Discriminator
from ksim_rl.objectives import AMPCfg, discriminator_loss, go_back, make_optimizer, style_reward
from ksim_rl.objectives.gradient_step import step
from ksim_rl.trainers.run_cfg import RunCfg

# Names of the logged means, by the names that `discriminator_loss` gives them.
LOGGED = {
    "loss": "loss/discriminator",
    "penalty": "style/gradient_penalty",
    "reference_score": "style/reference_score",
    "policy_score": "style/policy_score",
    "accuracy": "style/accuracy",
}


def make_amp_update(cfg: RunCfg, env: EnvBase, resumed: State | None = None) -> "AMPUpdate":
    """Build PPO and the discriminator of a run, and observe its reference motions."""
    objective: Any = cfg.objective
    ppo = make_ppo_update(cfg, env)
    # Successive frames of each clip are the transitions; none joins the end of one clip to another.
    transitions = []
    for file in objective.motions:
        # The env leaves out sets that none of its terms reads.
        seen = observe_motion(
            env, group=objective.style_group, file=file, motions=cfg.task.scene.motions
        )
        for seen_FL in seen:
            transitions.append(torch.stack((seen_FL[:-1], seen_FL[1:]), 1))
    reference_N2L = torch.cat(transitions)
    return AMPUpdate(objective, ppo=ppo, reference_N2L=reference_N2L, num_envs=cfg.num_envs)


class AMPUpdate(RolloutUpdate):
    """Rewards a rollout's transitions for looking like the reference motions, and improves the policy with that.

    In turn: the discriminator scores the rollout, PPO learns from it with both rewards, and the discriminator learns
    from the motions and the policy's last rollouts, in `replay`. A reference transition is the features before and
    after an env step.
    """

    def __init__(
        self, cfg: AMPCfg, *, ppo: PPOUpdate, reference_N2L: Float32[Tensor, "N 2 L"], num_envs: int
    ) -> None:
        if not bool(reference_N2L.isfinite().all()):
            raise ValueError(
                f"motions={cfg.motions!r}: group {cfg.style_group!r} is not finite in their states"
            )
        self.cfg = cfg
        self.ppo = ppo
        self.notes = ppo.notes
        self.actor = ppo.actor
        self.behavior = ppo.behavior
        self.set_progress = ppo.set_progress  # the discriminator's learning rate stays
        self.num_env_states = ppo.num_env_states
        self.reference_N2L = reference_N2L.to(ppo.device)
        self.discriminator = Discriminator(
            reference_N2L.shape[-1],
            hidden_dims=cfg.discriminator_hidden_dims,
            activation=cfg.discriminator_activation,
            device=ppo.device,
        )
        networks = {"discriminator": self.discriminator}
        options: Any = {"device": ppo.device, "signals": ppo.signals, "logged": LOGGED}
        super().__init__(networks, max_skipped_steps=cfg.max_skipped_steps, **options)
        # So that the first scores are of features in a fitting range. Ranks add up their counts.
        self.discriminator.normalizer.update(self.reference_N2L[ranks.rank() :: ranks.size()])
        rate = cfg.discriminator_learning_rate
        decay = cfg.discriminator_weight_decay
        # The discriminator has its own rate and decay, and all else from the config of PPO.
        own = dataclasses.replace(cfg, learning_rate=rate, weight_decay=decay, schedule="fixed")
        self.optimizer = make_optimizer(own, self.discriminator)
        num_steps = ppo.num_env_states // num_envs
        # Past transitions keep the discriminator from forgetting how earlier policies moved.
        kept = ReplayCfg(
            num_env_states_per_minibatch=cfg.num_transitions_per_step,
            num_minibatches=cfg.num_discriminator_steps,
            num_steps=num_steps,
            capacity=cfg.replay_rollouts * num_steps,
            shards=ppo.dataset.cfg.shards,
        )
        kept.rollout_length(num_envs)  # which refuses shards that are not equal
        self.replay = ReplayRing(
            kept, num_envs=num_envs, observations=[cfg.style_group], device=self.device
        )
        self._style = torch.zeros((), device=self.device)

    @property
    def rollout_keys(self) -> list[NestedKey]:
        """The leaves of an env state that an update reads."""
        return list(dict.fromkeys([*self.ppo.rollout_keys, *self._features]))

    @property
    def _features(self) -> tuple[NestedKey, NestedKey]:
        """Where the features before and after a step lie."""
        return self.cfg.style_group, unravel_key(("next", self.cfg.style_group))

    def metrics(self) -> dict[str, Num[Tensor, ""]]:
        """Return the measurements of the last update, each a tensor [] on the device.

        `style/reward` is the mean style reward of the rollout, in [0, 1]; the rest of `style/` are means over the
        discriminator's steps.
        """
        metrics = self.ppo.metrics()
        return {
            **metrics,
            **self._means,
            "style/reward": self._style,
            "update/skipped_steps": metrics["update/skipped_steps"] + self.guard.skipped,
            "update/skipped_in_a_row": torch.maximum(
                metrics["update/skipped_in_a_row"], self._longest_skip
            ),
        }

    def _update(self) -> None:
        # The order matters: scores are by the discriminator that has not yet seen this rollout.
        self.ppo(self._rewarded(self.rollout_ET))
        self._learn_style(self.rollout_ET)

    @torch.no_grad()
    def _rewarded(self, rollout_ET: TensorDictBase) -> TensorDictBase:
        """Return the rollout with the sum of both rewards, which leaves the env's own as it was."""
        style_ET = style_reward(
            self.discriminator(_transitions(rollout_ET, *self._features))
        ).unsqueeze(-1)
        # Scores of env states that are not finite are NaN, and the dataset removes those rows.
        self._style.copy_(style_ET.nanmean())
        reward = self.signals.following[0]
        total_ET = self.cfg.task_coeff * rollout_ET.get(reward) + self.cfg.style_coeff * style_ET
        return rollout_ET.copy().set(reward, total_ET)

    def _learn_style(self, rollout_ET: TensorDictBase) -> None:
        # The replay needs rewards and flags, by which it finds the ends of episodes.
        self.replay.extend(rollout_ET.select(*self._features, *STANDARD.following))
        net = self.discriminator
        made = []
        shown = []
        for minibatch_B in self.replay.minibatches(self.cfg.num_discriminator_steps):
            # As many reference transitions as there are of the policy, drawn with replacement.
            drawn_B = ranks.randint(
                len(self.reference_N2L), minibatch_B.batch_size, device=self.device
            )
            reference_B2L = self.reference_N2L[drawn_B]
            policy_B2L = _transitions(minibatch_B, *self._features)
            mask_B = minibatch_B.get(MASK_KEY).squeeze(-1)
            loss, logged = discriminator_loss(
                net.judge,
                net.normalized(reference_B2L),
                net.normalized(policy_B2L),
                gradient_penalty=self.cfg.gradient_penalty,
                mask_B=mask_B,
            )
            # A decay of the last layer only, which keeps the scores from growing without bound.
            last: Any = net.layers[-1]
            loss = loss + self.cfg.logit_decay * last.weight.square().sum()
            go_back({"loss": loss}, {"loss": self.optimizer}, mask=mask_B)
            _, skipped = step(self.optimizer, loss, max_grad_norm=self.cfg.max_grad_norm)
            self.guard.count_(skipped)
            made.append(
                logged
                | {"skipped": skipped, "skipped_in_a_row": self.guard.skipped_in_a_row.clone()}
            )
            shown += [reference_B2L, policy_B2L]
        # Only now, so that all steps see the statistics that the rollout was scored with.
        net.normalizer.update(torch.cat(shown))
        self._measure_(in_columns(made))

    def state_dict(self) -> state_tree.State:
        """Return PPO's state, and the discriminator with its optimizer and its replay."""
        return {
            **self.ppo.state_dict(),
            "discriminator": self.discriminator.state_dict(),
            "discriminator_optimizer": optimizer_state(self.optimizer),
            "discriminator_guard": self.guard.state_dict(),
            "replay": self.replay.state_dict(),
        }

    def load_state_dict(self, state: State) -> None:
        """Continue where `state_dict` was taken; see `RolloutUpdate`."""
        self.ppo.load_state_dict(state)
        super().load_weights(state)
        adam = branch(state, "discriminator_optimizer")
        load_optimizer_state(self.optimizer, adam, what="discriminator's Adam")
        guard = branch(state, "discriminator_guard")
        state_tree.copy_into(self.guard.state_dict(), guard, what="guard of the discriminator")
        self.replay.load_state_dict(branch(state, "replay"))

    def load_weights(self, state: State) -> None:
        """Take only the networks of a `state_dict`; from a run of plain PPO, the networks of the policy."""
        self.ppo.load_weights(state)
        if "discriminator" in state:
            super().load_weights(state)


def _transitions(env_states: TensorDictBase, before: NestedKey, after: NestedKey) -> Tensor:
    """Return the features before and after each step, [*batch, 2, L]."""
    return torch.stack((env_states.get(before), env_states.get(after)), -2)
