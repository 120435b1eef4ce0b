"""Trains a policy with PPO in one file: collect, estimate advantages, update, in that order.

    python examples/one_file_ppo.py task=cartpole_balance
    python examples/one_file_ppo.py task=go1_velocity_flat device=cuda:0 num_iterations=500
    python examples/one_file_ppo.py num_envs=64 objective.learning_rate=3e-4 data.num_minibatches=4

It is what `ksim-rl train` does, without config files, checkpoints, loggers and evaluation: copy it, and change what you
like. Each part is one that the library has for you: the env, the networks, the collector, the dataset, the loss. On
CUDA a rollout is one CUDA graph, an update another, and nothing waits for the host between two lines that are printed.
"""

import ast
import importlib.util
import os
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule

from ksim_rl import envs
from ksim_rl.algorithms.ppo.fused import NotFused, fused_networks
from ksim_rl.collectors import CollectorCfg, RolloutCollector
from ksim_rl.data import DatasetBuffer, DatasetCfg
from ksim_rl.device.capture import Captured
from ksim_rl.envs.contract import EpisodeSums, part
from ksim_rl.modules import (
    ActorCfg,
    CriticCfg,
    make_actor,
    make_critic,
    observation_dim,
    update_normalizers,
)
from ksim_rl.objectives import (
    PPOCfg,
    StepGuard,
    in_precision,
    make_advantage,
    make_loss,
    make_optimizer,
    ppo_step,
    with_precision_of,
)
from ksim_rl.objectives.fused_ppo import why_not_fused

# ---- settings ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Settings:
    """All that a run is made of. What is not given comes from the task."""

    task: str
    device: str
    seed: int
    num_envs: int
    num_iterations: int
    log_interval: int
    actor: ActorCfg
    critic: CriticCfg
    data: DatasetCfg
    objective: PPOCfg


def read_settings(arguments: list[str]) -> Settings:
    """Return the settings of a task, changed by `name=value` and `part.name=value`."""
    given = dict(argument.split("=", 1) for argument in arguments)
    training = envs.task(name := given.pop("task", "cartpole_balance")).training
    settings = Settings(
        task=name,
        device=given.pop("device", "cuda:0" if torch.cuda.is_available() else "cpu"),
        seed=training.seed,
        num_envs=training.num_envs,
        num_iterations=training.trainer.num_iterations,
        log_interval=10,
        actor=training.modules.actor,
        critic=training.modules.critic,
        data=training.data,
        objective=training.objective,
    )
    for path, text in given.items():
        *owner, field = path.split(".")
        value = ast.literal_eval(text)
        if owner:
            settings = replace(
                settings, **{owner[0]: replace(getattr(settings, owner[0]), **{field: value})}
            )
        else:
            settings = replace(settings, **{field: value})
    return replace(settings, objective=with_precision_of(settings.objective, settings.device))


# ---- the algorithm -------------------------------------------------------------------------------------------------


class PPO:
    """Actor and critic, and how a rollout improves them (Schulman et al., arXiv 1707.06347)."""

    def __init__(self, settings: Settings, env: Any) -> None:
        self.cfg = cfg = settings.objective
        device = settings.device
        self.actor: ProbabilisticTensorDictSequential = make_actor(
            settings.actor,
            obs_dim=observation_dim(env.observation_spec, settings.actor.in_keys),
            action_spec=env.full_action_spec,
            device=device,
        )
        self.critic: TensorDictModule = make_critic(
            settings.critic,
            obs_dim=observation_dim(env.observation_spec, settings.critic.in_keys),
            device=device,
        )
        self.estimate_advantages = make_advantage(cfg, self.actor, self.critic)
        loss = make_loss(cfg, self.actor, self.critic)
        self.loss = in_precision(loss, cfg.precision, device=device)
        self.optimizer = make_optimizer(cfg, self.actor, self.critic)
        self.dataset = DatasetBuffer(
            settings.data, keys=loss.dataset_keys, seed=settings.seed, device=device
        )
        self.guard = StepGuard(device=device)
        self.fused = make_fused(settings, self) if device.startswith("cuda") else None
        self.kl = torch.zeros((), device=device)
        self.rollout_ET: TensorDictBase | None = None
        # The first calls run eagerly, the next is captured in a CUDA graph; on the CPU all are plain calls.
        self._captured_update = Captured(self._update, device=device)

    @property
    def rollout_keys(self) -> list[Any]:
        """The leaves of an env state that an update reads."""
        written = ["action", "action_log_prob", "loc", "scale"]
        following = [*self.critic.in_keys, "reward", "done", "terminated"]
        return [
            *dict.fromkeys([*self.actor.in_keys, *self.critic.in_keys]),
            *written,
            *(("next", key) for key in following),
        ]

    def update(self, rollout_ET: TensorDictBase) -> None:
        """Improve actor and critic with a rollout `["E","T"]`, which must be the same memory at each call."""
        self.rollout_ET = rollout_ET
        self._captured_update()

    def _update(self) -> None:
        rollout_ET = self.rollout_ET
        assert rollout_ET is not None
        if self.fused is not None:
            # The same numbers in a few Triton kernels: docs/fused_ppo.md.
            orders_KD = self.dataset.epoch_orders(self.cfg.num_epochs)
            steps, _ = self.fused(rollout_ET, orders_KD)
            self.kl.copy_(steps["kl"][-1])
        else:
            # Writes "advantage" and "value_target"; the value after a step is computed from the true next observation.
            self.dataset.extend(self.estimate_advantages(rollout_ET))
            for minibatch_B in self._minibatches():
                step = ppo_step(
                    self.loss, self.optimizer, minibatch_B, cfg=self.cfg, guard=self.guard
                )
                self.kl.copy_(step["kl"])
        # Only now, so that all gradient steps see the statistics that the rollout's actions were drawn with.
        update_normalizers(rollout_ET, self.actor, self.critic)

    def _minibatches(self) -> Iterator[TensorDictBase]:
        for _ in range(self.cfg.num_epochs):
            yield from self.dataset.epoch()


def make_fused(settings: Settings, ppo: PPO) -> Any:
    """Return the fused kernels for the gradient steps, or None where they do not fit the networks."""
    if importlib.util.find_spec("triton") is None:
        return None
    networks, data = fused_networks(ppo.actor, ppo.critic), settings.data
    sizes: Any = {
        "num_env_states_per_minibatch": data.num_env_states_per_minibatch,
        "num_minibatches": data.num_minibatches,
    }
    if (
        isinstance(networks, NotFused)
        or why_not_fused(settings.objective, networks, **sizes) is not None
    ):
        return None
    from ksim_rl.objectives.fused_ppo.fused_ppo import FusedPPO

    return FusedPPO(settings.objective, networks, optimizer=ppo.optimizer, guard=ppo.guard, **sizes)


# ---- the loop ------------------------------------------------------------------------------------------------------


def train(settings: Settings) -> list[dict[str, float]]:
    """Train, print a line every `log_interval` iterations, and return what the lines say."""
    torch.manual_seed(settings.seed)
    torch.set_float32_matmul_precision("high")
    # One core stays free for Warp: threads that wait for a core that is taken make small products many times slower.
    torch.set_num_threads(max(1, min(8, (os.cpu_count() or 1) - 1)))
    env = envs.make(
        settings.task, num_envs=settings.num_envs, device=settings.device, seed=settings.seed
    )
    ppo = PPO(settings, env)
    collector = RolloutCollector(
        env,
        ppo.actor,
        rollout_length=settings.data.rollout_length(settings.num_envs),
        keys=ppo.rollout_keys,
        cfg=CollectorCfg(stagger_episodes=True),
    )
    lines, since, before = [], time.perf_counter(), 0
    for iteration in range(1, settings.num_iterations + 1):
        rollout_ET = collector.collect()
        ppo.update(rollout_ET)
        if iteration % settings.log_interval == 0 or iteration == settings.num_iterations:
            # Reading a tensor waits for the device: here, and nowhere else.
            figures = episode_figures(env) | {
                "kl": float(ppo.kl),
                "skipped_steps": float(ppo.guard.skipped),
            }
            now = time.perf_counter()
            env_states = (iteration - before) * settings.data.num_env_states
            lines.append(
                {
                    "iteration": iteration,
                    "env_states_per_s": env_states / (now - since),
                    **figures,
                }
            )
            since, before = now, iteration
            print("  ".join(f"{name} {value:.4g}" for name, value in lines[-1].items()), flush=True)
    return lines


def episode_figures(env: Any) -> dict[str, float]:
    """Return the mean return and length of the episodes that ended since the last call."""
    sums = part(env, EpisodeSums)
    if sums is None:
        return {}
    log = {name: float(value) for name, value in sums.episode_log().items()}
    sums.episode_log_reset_()
    episodes = max(log["episodes"], 1.0)
    return {"return": log["return_sum"] / episodes, "length": log["length_sum"] / episodes}


if __name__ == "__main__":
    train(read_settings(sys.argv[1:]))
