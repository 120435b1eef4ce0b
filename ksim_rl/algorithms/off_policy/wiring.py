"""Builds SAC, TD3 and their fast variants for a run: networks, loss, exploration and update."""

from collections.abc import Callable
from functools import partial
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from ksim_rl.algorithms.off_policy.update import OffPolicyUpdate
from ksim_rl.algorithms.recorded import read_offline_table
from ksim_rl.checks import naming
from ksim_rl.data import ReplayCfg
from ksim_rl.device.state_tree import State
from ksim_rl.envs.signal_keys import signal_keys
from ksim_rl.mdp.mirror_maps import mirror_maps
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
from ksim_rl.modules.bounded_actors import BoundedActor, BoundedActorCfg
from ksim_rl.objectives import OffPolicyLoss, SACCfg, SACLoss, TD3Loss
from ksim_rl.trainers.algorithm import Algorithm, part_of
from ksim_rl.trainers.run_cfg import RunCfg
from ksim_rl.transforms import stacked_frames


def make_off_policy_update(
    cfg: RunCfg, env: EnvBase, resumed: State | None = None
) -> OffPolicyUpdate:
    """Build the update of a run; one that is resumed is built like a new one."""
    objective: Any = cfg.objective
    actor: Any = make_off_policy_policy(cfg, env)
    with naming("modules.critic"):
        critic: Any = make_for_spec(
            make_q_network,
            part_of(cfg, "modules.critic", QNetworkCfg),
            env.observation_spec,
            action_dim=env.action_spec.shape[-1],
            device=cfg.resolved_device(),
        )
    judge = next(module for module in critic.modules() if isinstance(module, QNetwork))
    # The bounds of the actions are buffers of the actor, whatever modules wrap it.
    bounded = next(module for module in actor.modules() if isinstance(module, BoundedActor))
    bounds: dict[str, Any] = {"low_L": bounded.low, "high_L": bounded.high}
    learned: dict[str, Any] = {"support_A": judge.support}
    # Both losses take the discount and the way in which critics are reduced.
    learned |= {name: getattr(objective, name) for name in ("gamma", "value_reduction")}
    noise = {}
    loss: OffPolicyLoss
    if isinstance(objective, SACCfg):
        # The entropy of actions that are scaled from [-1, 1] differs by the logarithm of that scale.
        scale = float(((bounded.high - bounded.low) / 2).log().sum())
        loss = SACLoss(
            actor,
            critic,
            target_entropy=len(bounded.low) * objective.target_entropy_per_action + scale,
            alpha_init=objective.alpha_init,
            learn_alpha=objective.alpha_learning_rate > 0.0,
            **learned,
        )
    else:
        target = {name: getattr(objective, name) for name in ("target_noise", "target_noise_clip")}
        loss = TD3Loss(actor, critic, **bounds, **target, **learned)
        # SAC explores by its own draws; TD3's policy is deterministic, and needs noise.
        noise = {
            "noise_min": objective.exploration_noise_min,
            "noise_max": objective.exploration_noise_max,
        }
    data = part_of(cfg, "data", ReplayCfg)
    update = OffPolicyUpdate(
        objective,
        loss=loss,
        behavior=ExploringPolicy(actor, **bounds, num_envs=cfg.num_envs, **noise),
        data=data,
        num_envs=cfg.num_envs,
        device=cfg.resolved_device(),
        mirror=mirror_maps(env, loss.observation_keys) if objective.symmetry != "none" else None,
        signals=signal_keys(env),
        stacks=stacked_frames(env),
    )
    if data.offline is not None:
        table, update.notes = read_offline_table(
            data,
            env,
            observations=loss.observation_keys,
            gamma=objective.gamma,
            device=update.device,
        )
        update.learn_also_from(table)
    return update


def make_off_policy_policy(cfg: RunCfg, env: EnvBase) -> TensorDictModuleBase:
    """Build the policy of a run: with SAC's settings one that draws its actions, with TD3's one that does not."""
    # The settings of the algorithm decide the kind of policy, which the config of the networks has to match.
    if isinstance(cfg.objective, SACCfg):
        return make_squashed_policy(cfg, env)
    return _bounded_policy(cfg, env, make_deterministic_actor, DeterministicActorCfg)


def make_squashed_policy(cfg: RunCfg, env: EnvBase) -> TensorDictModuleBase:
    """Build the policy of a run as SAC has it, whatever its objective is."""
    return _bounded_policy(cfg, env, make_squashed_actor, SquashedActorCfg)


def _bounded_policy(
    cfg: RunCfg,
    env: EnvBase,
    make: Callable[..., TensorDictModuleBase],
    kind: type[BoundedActorCfg],
) -> TensorDictModuleBase:
    with naming("modules.actor"):
        return make_for_spec(
            make,
            part_of(cfg, "modules.actor", kind),
            env.observation_spec,
            action_spec=env.action_spec,
            device=cfg.resolved_device(),
        )


OFF_POLICY = partial(
    Algorithm, update=make_off_policy_update, policy=make_off_policy_policy, on_ranks=True
)
"""Makes an algorithm of these from its name and settings, and the data and networks that suit it."""
