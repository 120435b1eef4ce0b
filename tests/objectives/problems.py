"""Small rollouts and networks that the tests of this folder share."""

import torch
from tensordict import TensorDict

from ksim_rl import dims
from ksim_rl.modules import ActorCfg, CriticCfg, make_actor, make_critic

ACTOR_DIM, CRITIC_DIM, ACTION_DIM = 5, 7, 2


def networks(*, obs_normalization=True, **actor_options):
    actor_cfg = ActorCfg(
        hidden_dims=(16, 16), obs_normalization=obs_normalization, output_gain=0.5, **actor_options
    )
    critic_cfg = CriticCfg(hidden_dims=(16, 16), obs_normalization=obs_normalization)
    actor = make_actor(actor_cfg, obs_dim=ACTOR_DIM, action_dim=ACTION_DIM)
    critic = make_critic(critic_cfg, obs_dim=CRITIC_DIM)
    return actor, critic


def rollout(actor, *, num_envs=8, length=6, end_probability=0.15, device="cpu"):
    """Return random env states `["E","T"]` with terminations, truncations, and both at once."""
    shape = (num_envs, length)
    terminated = torch.rand(*shape, 1) < end_probability
    truncated = torch.rand(*shape, 1) < end_probability
    data = TensorDict(
        {
            "actor": torch.randn(*shape, ACTOR_DIM),
            "critic": torch.randn(*shape, CRITIC_DIM),
            "next": {
                "actor": torch.randn(*shape, ACTOR_DIM),
                "critic": torch.randn(*shape, CRITIC_DIM),
                "reward": torch.randn(*shape, 1),
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
            },
        },
        shape,
    ).to(device)
    with torch.no_grad():
        actor(data)
    return dims.name(data, dims.E, dims.T)


def minibatch(actor, critic, *, size=64, drift=0.1):
    """Return a minibatch `["B"]` as a dataset gives it, and move both networks away from those that made it."""
    data = rollout(actor, num_envs=size, length=1).reshape(-1)
    with torch.no_grad():
        critic(data)
        data["advantage"] = torch.randn(size, 1)
        data["value_target"] = data["state_value"] + torch.randn(size, 1)
        for parameter in (*actor.parameters(), *critic.parameters()):
            parameter.add_(drift * torch.randn_like(parameter))
    return dims.name(data.exclude("next"), dims.B)
