"""Actor and critic of a run, made for what its env observes and does."""

from functools import partial
from typing import Any

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.modules import ActorValueOperator

from ksim_rl.modules import (
    FEATURES,
    ActorCfg,
    CriticCfg,
    ObservationKey,
    RecurrentStatePrimer,
    make_actor,
    make_critic,
    make_recurrent_actor,
    make_recurrent_critic,
    make_shared_trunk,
    observation_dim,
    recurrent_transforms,
    state_spec,
)
from ksim_rl.trainers.run_cfg import ModulesCfg, RunCfg


def build_networks(cfg: RunCfg, env: EnvBase) -> tuple[ProbabilisticTensorDictSequential, TensorDictModule]:
    """Build actor and critic for the observation groups and actions of an env.

    Raises:
        ValueError: if the networks are those of an off-policy method.
    """
    device, modules = cfg.resolved_device(), cfg.modules
    if not isinstance(modules.actor, ActorCfg) or not isinstance(modules.critic, CriticCfg):
        raise ValueError(
            f"modules are {type(modules.actor).__name__} and {type(modules.critic).__name__}, and a state value needs "
            "ActorCfg and CriticCfg: use modules=mlp"
        )
    spec: Any = env.observation_spec

    def width(keys: tuple[ObservationKey, ...]) -> int:
        own = [key for key in keys if key != FEATURES]
        shared = modules.trunk.hidden_dims[-1] if modules.trunk is not None else 0
        return observation_dim(spec, own) + shared

    trunk = None
    if modules.trunk is not None:
        trunk = make_shared_trunk(
            modules.trunk, obs_dim=observation_dim(spec, modules.trunk.in_keys), device=device
        )
    # Behind a memory, where there is one.
    new_actor = partial(make_recurrent_actor, m) if (m := modules.recurrent_actor) else make_actor
    new_critic = partial(make_recurrent_critic, m) if (m := modules.recurrent_critic) else make_critic
    actor = new_actor(
        modules.actor,
        obs_dim=width(modules.actor.in_keys),
        action_spec=env.full_action_spec,
        device=device,
    )
    critic = new_critic(modules.critic, obs_dim=width(modules.critic.in_keys), device=device)
    if trunk is None:
        return actor, critic
    both = ActorValueOperator(trunk, actor, critic)
    return both.get_policy_operator(), both.get_value_operator()  # type: ignore[return-value]


def with_recurrent_state(env: TransformedEnv, modules: ModulesCfg) -> TransformedEnv:
    """Let an env carry what the policy remembers, and tell networks with a memory where episodes begin."""
    if modules.recurrent:
        cfg = modules.recurrent_actor
        primers = [] if cfg is None else [RecurrentStatePrimer(state_spec(cfg, "actor"))]
        for transform in recurrent_transforms(env, *primers):
            env.append_transform(transform)
    return env
