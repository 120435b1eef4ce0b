"""Builds PPO for a run: actor and critic for the observations and actions of its env, and their update."""

from functools import partial

import torch
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.modules import ActorValueOperator

from ksim_rl.algorithms.ppo.update import PPOUpdate
from ksim_rl.checks import naming
from ksim_rl.data import DatasetCfg
from ksim_rl.envs.signal_keys import signal_keys
from ksim_rl.mdp.mirror_maps import mirror_maps
from ksim_rl.modules import (
    FEATURES,
    ActorCfg,
    CriticCfg,
    make_actor,
    make_critic,
    make_for_spec,
    make_recurrent_actor,
    make_recurrent_critic,
    make_shared_trunk,
)
from ksim_rl.modules.network import LayeredNetwork, check_unused
from ksim_rl.objectives import PPOCfg, observation_keys
from ksim_rl.trainers.algorithm import part_of
from ksim_rl.trainers.run_cfg import RunCfg


def make_ppo_update(cfg: RunCfg, env: EnvBase, resumed: object = None) -> PPOUpdate:
    """Build the PPO update of a run; one that is resumed is built like a new one."""
    assert isinstance(cfg.objective, PPOCfg)
    actor, critic = build_networks(cfg, env)
    # Only observations that a network reads need a mirror image.
    read = list(dict.fromkeys((*observation_keys(actor), *critic.in_keys)))
    return PPOUpdate(
        cfg.objective,
        actor=actor,
        critic=critic,
        data=part_of(cfg, "data", DatasetCfg),
        seed=cfg.seed,
        device=cfg.resolved_device(),
        mirror=mirror_maps(env, read) if cfg.objective.symmetry != "none" else None,
        signals=signal_keys(env),
    )


def make_ppo_policy(cfg: RunCfg, env: EnvBase) -> ProbabilisticTensorDictSequential:
    """Build the policy of a run."""
    return build_networks(cfg, env)[0]


def build_networks(
    cfg: RunCfg, env: EnvBase
) -> tuple[ProbabilisticTensorDictSequential, TensorDictModule]:
    """Build actor and critic for an env's observations and actions; a ValueError refuses an off-policy method's."""
    modules = cfg.modules
    actor_cfg = part_of(cfg, "modules.actor", ActorCfg)
    critic_cfg = part_of(cfg, "modules.critic", CriticCfg)
    spec: Composite = env.observation_spec
    made = partial(make_for_spec, device=cfg.resolved_device())

    trunk = None
    if modules.trunk is not None:
        with naming("modules.trunk"):
            check_unused(spec, FEATURES)
            trunk = made(make_shared_trunk, modules.trunk, spec)
        layers = next(own for own in trunk.modules() if isinstance(own, LayeredNetwork))
        # Both networks read its features as one more observation.
        spec = spec.clone()
        spec[FEATURES] = Unbounded(torch.Size([*spec.shape, layers.output_dim]), device=spec.device)

    # Behind a recurrent module, where there is one.
    if m := modules.recurrent_actor:
        new_actor = partial(make_recurrent_actor, m)
    else:
        new_actor = make_actor
    if m := modules.recurrent_critic:
        new_critic = partial(make_recurrent_critic, m)
    else:
        new_critic = make_critic
    with naming("modules.actor"):
        actor = made(new_actor, actor_cfg, spec, action_spec=env.full_action_spec)
    with naming("modules.critic"):
        critic = made(new_critic, critic_cfg, spec)
    if trunk is None:
        return actor, critic
    # Both operators run the same trunk, and so learn the same weights in it.
    both = ActorValueOperator(trunk, actor, critic)
    return both.get_policy_operator(), both.get_value_operator()  # type: ignore[return-value]
