"""Records the metrics of healthy and of sabotaged runs, on which `ksim-rl diagnose` is tested.

    python -m benchmarks.diagnosis runs=healthy
    python -m benchmarks.diagnosis runs=faults

trains small runs on the CPU, one after the other, and keeps their curves in benchmarks/results/diagnosis.json, under
`healthy` and under `faults`, those by the name of the check that has to find them. `only=NAME,...` chooses among them.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from benchmarks import command_line, report
from ksim_rl.modules import ObservationNormalizer
from ksim_rl.runs.csv_table import read_table, thinned
from ksim_rl.trainers import Hook, RunProgress, Trainer, build

KEPT_ROWS = 30
KEPT = (
    "env_states",
    "loss/",
    "update/",
    "policy/",
    "rollout/",
    "episode/",
    "reward/",
    "termination/",
    "style/",
)
LOCAL = (
    "device=cpu",
    "logger=local",
    "trainer.eval_episodes=8",
    "trainer.eval_interval=5",
    "trainer.checkpoint_interval=0",
    "trainer.video=false",
)
NETWORKS = ("modules.actor.hidden_dims=[64,64]", "modules.critic.hidden_dims=[64,64]")
PPO = (
    "num_envs=64",
    "data.num_env_states_per_minibatch=512",
    "data.num_minibatches=4",
    "objective.learning_rate=1e-3",
    "trainer.num_iterations=30",
)
OFF_POLICY = (
    "num_envs=32",
    "data.num_steps=4",
    "data.num_env_states_per_minibatch=256",
    "data.num_minibatches=8",
    "data.learning_starts=10",
    "data.capacity=1000",
    "trainer.num_iterations=50",
)
SWING_UP = ("task=cartpole_swingup", *PPO, *NETWORKS)
SHORT, FAST = "trainer.num_iterations=15", "objective.learning_rate=0.05"
WALKER = ("task=walker_walk", *PPO, *NETWORKS)
QUADRUPED = ("task=quadruped_velocity_flat", *PPO, *NETWORKS)


def off_policy(task: str, objective: str, seed: int) -> tuple[str, ...]:
    """Return the overrides of a run of SAC or TD3."""
    return f"task={task}", f"objective={objective}", f"seed={seed}", *OFF_POLICY, *NETWORKS


HEALTHY: dict[str, tuple[str, ...]] = {
    **{f"cartpole_swingup_ppo_{seed}": (*SWING_UP, f"seed={seed}") for seed in (1, 2)},
    "cartpole_balance_ppo": ("task=cartpole_balance", *PPO, *NETWORKS),
    "cartpole_swingup_lstm": (
        "task=cartpole_swingup",
        "modules=lstm",
        *PPO,
        *NETWORKS,
        "objective.num_epochs=2",
        "trainer.num_iterations=20",
    ),
    "cartpole_swingup_shared_trunk": ("task=cartpole_swingup", "modules=shared_trunk", *PPO),
    "cartpole_swingup_tanh": (*SWING_UP, "modules.actor.distribution=tanh_gaussian"),
    "cartpole_swingup_relu": (
        *SWING_UP,
        "modules.actor.activation=relu",
        "modules.critic.activation=relu",
    ),
    **{
        f"pendulum_swingup_ppo_{seed}": ("task=pendulum_swingup", *PPO, *NETWORKS, f"seed={seed}")
        for seed in (1, 2)
    },
    **{f"walker_walk_ppo_{seed}": (*WALKER, f"seed={seed}") for seed in (1, 2)},
    "hopper_stand_ppo": ("task=hopper_stand", *PPO, *NETWORKS),
    "reacher_ppo": ("task=reacher", *PPO, *NETWORKS),
    **{f"quadruped_ppo_{seed}": (*QUADRUPED, f"seed={seed}") for seed in (1, 2)},
    "arm_reach_ppo": ("task=arm_reach", *PPO, *NETWORKS),
    "walker_amp": (
        "task=walker_amp",
        "objective=amp",
        *PPO,
        *NETWORKS,
        "objective.num_transitions_per_step=512",
    ),
    "cartpole_swingup_sac": off_policy("cartpole_swingup", "sac", 1),
    "pendulum_swingup_sac": off_policy("pendulum_swingup", "sac", 2),
    "cartpole_swingup_td3": off_policy("cartpole_swingup", "td3", 1),
    "pendulum_swingup_fast_sac": off_policy("pendulum_swingup", "fast_sac", 1),
    "cartpole_swingup_fast_td3": off_policy("cartpole_swingup", "fast_td3", 1),
}


class Shrinking(Hook):
    """Multiplies the standard deviation of the actions by a factor after each iteration."""

    def __init__(self, factor: float) -> None:
        self.factor = factor

    @torch.no_grad()
    def __call__(self, trainer: Trainer) -> None:
        """Shrink it."""
        for name, parameter in trainer.update.actor.named_parameters():
            if name.endswith(".std"):
                parameter.mul_(self.factor)


class Contrary(Hook):
    """Lets the critic say the opposite after each iteration."""

    @torch.no_grad()
    def __call__(self, trainer: Trainer) -> None:
        """Change the sign of its last layer."""
        *_, weight, bias = _critic(trainer).parameters()
        weight.neg_()
        bias.neg_()


def killed_units(trainer: Trainer) -> None:
    """Push three quarters of the first layers' units below the threshold of the ReLU, where they stay."""
    with torch.no_grad():
        for name, parameter in [
            *trainer.update.actor.named_parameters(),
            *_critic(trainer).named_parameters(),
        ]:
            if name.endswith((".0.bias", ".2.bias")):
                parameter[: 3 * len(parameter) // 4] = -1e3


def frozen_normalizers(trainer: Trainer) -> None:
    """Let the normalizers keep statistics of observations that were far smaller."""
    for network in (trainer.update.actor, _critic(trainer)):
        for module in network.modules():
            if isinstance(module, ObservationNormalizer):
                module.update(0.1 * torch.randn(1000, module.dim))
                module.until = 1


def _critic(trainer: Trainer) -> Any:
    update: Any = trainer.update
    return update.critic


Sabotage = Callable[[Trainer], None]
# By the name of the check that has to find it: overrides, hooks, and what is done to the trainer before it starts.
FAULTS: dict[str, tuple[tuple[str, ...], tuple[Hook, ...], Sabotage | None]] = {
    "entropy_collapsed": (SWING_UP, (Shrinking(0.9),), None),
    "std_at_floor": ((*SWING_UP, SHORT), (Shrinking(0.3),), None),
    "value_error_exploding": (
        (
            *off_policy("pendulum_swingup", "td3", 1),
            "objective.critic_learning_rate=0.03",
            "objective.tau=1.0",
            "objective.gamma=1.0",
            "objective.value_reduction=mean",
        ),
        (),
        None,
    ),
    "negative_explained_variance": (
        (*SWING_UP, SHORT),
        (Contrary(),),
        None,
    ),
    "kl_far_off": (
        (*SWING_UP, SHORT, "objective.schedule=fixed", FAST, "objective.clip_epsilon=1.0"),
        (),
        None,
    ),
    "most_ratios_clipped": (
        (*SWING_UP, SHORT, "objective.learning_rate=0.01", "objective.clip_epsilon=1e-4"),
        (),
        None,
    ),
    "episodes_end_at_once": (
        (*QUADRUPED, "task.terminations.fell_over.limit_angle=0.02"),
        (),
        None,
    ),
    "penalty_outweighs": ((*QUADRUPED, "task.rewards.action_rate_l2.weight=-10.0"), (), None),
    "saturated_actions": ((*SWING_UP, "modules.actor.init_std=50.0"), (), None),
    "dead_units": (
        (*SWING_UP, "modules.actor.activation=relu", "modules.critic.activation=relu"),
        (),
        killed_units,
    ),
    "stale_normalizer": (SWING_UP, (), frozen_normalizers),
}


def main() -> None:
    """Train the runs that are asked for, and keep their curves, each as soon as it is there."""
    given = command_line.options(sys.argv[1:], {"runs": "healthy", "only": ""})
    table: dict[str, Any] = {"healthy": HEALTHY, "faults": FAULTS}[given["runs"]]
    for name in given["only"].split(",") if given["only"] else table:
        found: Any = table[name] if given["runs"] == "faults" else (table[name], (), None)
        kept = train(*found)
        rows: dict[str, Any] = {given["runs"]: {name: kept}}
        report.write(
            "diagnosis",
            figures={f"cpu/{name}/reward": float(_last(kept["metrics"]["rollout/reward"]))},
            device=torch.device("cpu"),
            module="benchmarks.diagnosis",
            **rows,
        )
        print(name, {metric: _last(row) for metric, row in kept["metrics"].items()}, flush=True)


def _last(text: str) -> str:
    """Return the last number, which some rows do not have."""
    return next((word for word in reversed(text.split()) if word != "-"), "-")


def train(
    overrides: tuple[str, ...], hooks: tuple[Hook, ...], sabotage: Sabotage | None
) -> dict[str, Any]:
    """Train a run, and return the parts of its config and the metrics that a diagnosis reads."""
    cfg = command_line.compose([*overrides, *LOCAL])
    with tempfile.TemporaryDirectory() as folder:
        trainer = build(cfg, run_folder=Path(folder), hooks=hooks)
        if sabotage is not None:
            sabotage(trainer)
        trainer.train(RunProgress(cfg.trainer.num_iterations, enabled=False))
        _, rows = read_table(Path(folder) / "metrics.csv")
    tree = cfg.to_tree()
    config = {"objective": tree["objective"], "modules": {"actor": tree["modules"]["actor"]}}
    return {"overrides": list(overrides), "config": config, "metrics": kept_metrics(rows)}


def kept_metrics(rows: list[dict[str, str]]) -> dict[str, str]:
    """Return about `KEPT_ROWS` rows, the last one among them, each metric in one text; "-" where a row has none."""
    rows = thinned(rows, KEPT_ROWS)
    names = [name for name in rows[-1] if name.startswith(KEPT)]
    return {
        name: " ".join(f"{float(row[name]):.4g}" if row.get(name) else "-" for row in rows)
        for name in names
    }


if __name__ == "__main__":
    command_line.run(main)
