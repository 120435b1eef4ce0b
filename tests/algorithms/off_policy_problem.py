"""Off-policy learning of `TargetEnv`, whose best action values are known."""

from dataclasses import replace

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from ksim_rl.algorithms.bc.demonstration import Demonstration
from ksim_rl.algorithms.bc.update import BCUpdate
from ksim_rl.collectors import RolloutCollector
from ksim_rl.data import DatasetCfg, ReplayCfg, make_offline_table
from ksim_rl.envs.signal_keys import STANDARD
from ksim_rl.modules import (
    DeterministicActorCfg,
    ExploringPolicy,
    QNetwork,
    QNetworkCfg,
    SquashedActorCfg,
    make_deterministic_actor,
    make_for_spec,
    make_q_network,
    make_squashed_actor,
)
from ksim_rl.objectives import BCCfg, SACCfg, SACLoss, TD3Cfg, TD3Loss
from ksim_rl.trainers import Evaluator, OffPolicyUpdate, Trainer, TrainerCfg
from tests.trainers.target_env import LENGTH, make_env

GAMMA = 0.9
SHARED = {"gamma": GAMMA, "critic_learning_rate": 3e-3, "actor_learning_rate": 3e-3, "tau": 0.1}
OBJECTIVES = {
    "sac": SACCfg(alpha_init=0.02, alpha_learning_rate=0.0, **SHARED),
    "fast_sac": SACCfg(
        alpha_init=0.02, alpha_learning_rate=0.0, value_reduction="mean", policy_delay=2, **SHARED
    ),
    "td3": TD3Cfg(
        exploration_noise_min=0.05, exploration_noise_max=0.3, target_noise=0.05, **SHARED
    ),
    "fast_td3": TD3Cfg(
        exploration_noise_min=0.05, exploration_noise_max=0.3, target_noise=0.05, **SHARED
    ),
}


def make_update(
    name,
    env,
    *,
    device="cpu",
    objective=None,
    obs_dim=1,
    support=(-15.0, 15.0),
    signals=STANDARD,
    sees=None,
    **data,
):
    """Return the update of an algorithm for an env with actions of one number; `data` are fields of `ReplayCfg`.

    Fields in `sees` say what both networks read of the env, `obs_dim` numbers unless given.
    """
    cfg = objective or OBJECTIVES[name]
    fields = {
        "num_env_states_per_minibatch": 128,
        "num_minibatches": 8,
        "num_steps": 4,
        "capacity": 200,
        "learning_starts": 8,
    }

    def build(make, network, **options):
        if sees is None:
            return make(network, obs_dim=obs_dim, device=device, **options)
        seeing = replace(network, **sees)
        return make_for_spec(make, seeing, env.observation_spec, device=device, **options)

    make, kind = (
        (make_squashed_actor, SquashedActorCfg)
        if isinstance(cfg, SACCfg)
        else (make_deterministic_actor, DeterministicActorCfg)
    )
    policy = kind(hidden_dims=(32,), activation="silu", action_bound=2.0, layer_norm=True)
    actor = build(make, policy, action_spec=env.action_spec[0])
    # The support reaches beyond the best value of each probe.
    atoms = (
        {"num_atoms": 41, "v_min": support[0], "v_max": support[1]}
        if name.startswith("fast")
        else {}
    )
    judge = QNetworkCfg(hidden_dims=(64, 64), activation="silu", **atoms)
    critic = build(make_q_network, judge, action_dim=1)
    (values,) = [part for part in critic.modules() if isinstance(part, QNetwork)]
    low, high = torch.full((2, 1), 2.0, device=device) * torch.tensor(
        [[-1.0], [1.0]], device=device
    )
    shared = {
        "support_A": values.support,
        "gamma": cfg.gamma,
        "value_reduction": cfg.value_reduction,
    }
    noise = {}
    if isinstance(cfg, SACCfg):
        loss = SACLoss(
            actor,
            critic,
            target_entropy=-1.0,
            alpha_init=cfg.alpha_init,
            learn_alpha=cfg.alpha_learning_rate > 0.0,
            **shared,
        )
    else:
        loss = TD3Loss(
            actor, critic, low_L=low, high_L=high, target_noise=cfg.target_noise, **shared
        )
        noise = {"noise_min": cfg.exploration_noise_min, "noise_max": cfg.exploration_noise_max}
    num_envs = env.batch_size[0]
    behavior = ExploringPolicy(actor, low_L=low, high_L=high, num_envs=num_envs, **noise)
    return OffPolicyUpdate(
        cfg,
        loss=loss,
        behavior=behavior,
        data=ReplayCfg(**(fields | data)),
        num_envs=num_envs,
        device=device,
        signals=signals,
    )


def make_trainer(
    name, folder=None, *, seed=0, iterations=6, env=None, objective=None, data=None, **cfg
):
    """Return a trainer for `TargetEnv`; `cfg` are fields of `TrainerCfg`, `data` fields of `ReplayCfg`."""
    torch.manual_seed(seed)
    env = make_env(32, seed=seed) if env is None else env
    update = make_update(name, env, objective=objective, **(data or {}))
    fields = {"num_iterations": iterations, "eval_interval": 0, "checkpoint_interval": 0, **cfg}
    evaluation_env = make_env(10)
    evaluation_env.eval()
    return Trainer(
        TrainerCfg(**fields),
        collector=RolloutCollector(
            env, update.behavior, rollout_length=update.data.num_steps, keys=update.rollout_keys
        ),
        update=update,
        evaluator=Evaluator(evaluation_env, update.actor, max_steps=LENGTH, seed=7),
        folder=folder,
    )


def clone_for(name, *, noise=0.1, num_updates=20):
    """Return the state of a policy of `make_trainer(name)` that was cloned from near-best actions."""
    generator = torch.Generator().manual_seed(3)
    shown_N1 = 2.0 * torch.rand(4096, 1, generator=generator) - 1.0
    action_N1 = shown_N1 + noise * torch.randn(4096, 1, generator=generator)
    recorded_N = TensorDict({"actor": shown_N1, "action": action_N1}, [4096])
    torch.manual_seed(1)
    env = make_env(32)
    update = BCUpdate(
        BCCfg(episodes="made_up", learning_rate=0.01, num_epochs=8),
        actor=make_update(name, env).actor,
        critic=None,
        demonstration=Demonstration(learned_N=recorded_N, held_out_N=None),
        data=DatasetCfg(num_env_states_per_minibatch=128, num_minibatches=4),
    )
    collector = RolloutCollector(env, update.actor, rollout_length=16, keys=update.rollout_keys)
    for _ in range(num_updates):
        update(collector.collect())
    return update.state_dict()


def recorded_table(*, episodes=8, n_step=1, device="cpu"):
    """Return a table of the best actions in `TargetEnv`, as a recorder would have found them."""
    env = make_env(episodes)
    policy = TensorDictModule(torch.clone, in_keys=["actor"], out_keys=["action"])
    rollout_ET = env.rollout(LENGTH, policy, break_when_any_done=False)
    rows_D = rollout_ET.reshape(-1)
    rows_D["episode"] = torch.arange(episodes).repeat_interleave(LENGTH)
    return make_offline_table(
        rows_D,
        observations=["actor", "critic"],
        n_step=n_step,
        gamma=GAMMA,
        device=device,
    )
