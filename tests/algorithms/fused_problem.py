"""Networks, rollouts and updates that are small enough for Triton's interpreter."""

import copy
import importlib

import pytest
import torch
from tensordict import TensorDict

from ksim_rl.algorithms.ppo.fused import fused_networks
from ksim_rl.algorithms.ppo.update import PPOUpdate
from ksim_rl.data import DatasetCfg
from ksim_rl.modules import ActorCfg, CriticCfg, make_actor, make_critic
from ksim_rl.objectives import SymmetricAugmentation
from ksim_rl.objectives.fused_ppo import Tuning
from ksim_rl.transforms import MirrorMap

ENVS, STEPS, ACTIONS, ACTOR_OBS, CRITIC_OBS = 8, 6, 3, 20, 24
SIZES = {"num_env_states_per_minibatch": 24, "num_minibatches": 2}
DATA = DatasetCfg(**SIZES)
HIDDEN = (32, 32, 16)
# Blocks that do not divide the 24 rows of a minibatch or the layers; few, since the interpreter is slow.
LOWER = {"lower": 16, "lower_depth": 16, "lower_stages": 1}
TUNING = Tuning(
    block=16, chunk=16, stages=1, depth=16, tile=32, tile_stages=1, splits=2, size=1024, **LOWER
)
# A layer is a grid of programs; few of them are still more than one in each direction.
LAYERED = Tuning(block=32, stages=1, depth=32, tile=32, tile_stages=1, splits=2, size=4096)
MIRROR = {
    "actor": MirrorMap(
        source=(1, 0, *range(2, ACTOR_OBS)), signs=(1, 1, -1, *[1] * (ACTOR_OBS - 3))
    ),
    "critic": MirrorMap(source=(*range(CRITIC_OBS - 2), CRITIC_OBS - 1, CRITIC_OBS - 2)),
    "action": MirrorMap(source=(1, 0, 2), signs=(-1, -1, -1)),
}

needs_interpreter = pytest.mark.skipif(
    torch.cuda.is_available(), reason="tests/gpu runs the kernels themselves"
)


def networks(
    *, action_dim=ACTIONS, hidden=HIDDEN, critic=None, actor_obs=ACTOR_OBS, **actor_options
):
    torch.manual_seed(3)
    activation = actor_options.pop("activation", "elu")
    cfg = ActorCfg(hidden_dims=hidden, activation=activation, output_gain=0.5, **actor_options)
    actor = make_actor(cfg, obs_dim=actor_obs, action_dim=action_dim)
    return actor, make_critic(
        CriticCfg(hidden_dims=critic or hidden, activation=activation), obs_dim=CRITIC_OBS
    )


def rollout(actor, *, seed=0):
    """Return a rollout `["E","T"]` in time-major memory, with ends of both kinds and two env states to leave out."""
    torch.manual_seed(seed)
    shape = STEPS, ENVS
    terminated, truncated = torch.rand(*shape, 1) < 0.1, torch.rand(*shape, 1) < 0.1
    data = TensorDict(
        {
            "actor": torch.randn(*shape, actor[0].module.trunk[0].in_features) * 2.0 + 1.0,
            "critic": torch.randn(*shape, CRITIC_OBS),
            "next": {
                "critic": torch.randn(*shape, CRITIC_OBS),
                "reward": torch.randn(*shape, 1),
                "terminated": terminated,
                "done": terminated | truncated,
            },
        },
        shape,
    )
    with torch.no_grad():
        actor(data)
    # What follows is what the next step begins with, where it does not begin another episode.
    goes_on = ~data["next", "done"][:-1]
    data["next", "critic"][:-1] = data["critic"][1:].where(goes_on, data["next", "critic"][:-1])
    data["next", "reward"][2, 3] = float("nan")
    data["actor"][1, 5, 2] = float("inf")
    return data.transpose(0, 1)


def update(cfg, actor, critic, fused_ppo=None, *, data=DATA):
    copies = {"actor": copy.deepcopy(actor), "critic": copy.deepcopy(critic)}
    made = PPOUpdate(cfg, **copies, data=data, seed=5, mirror=MIRROR)
    if fused_ppo is not None:
        description = fused_networks(made.actor, made.critic)
        chained = description.chained and cfg.symmetry != "loss"
        made.fused = fused_ppo(
            cfg,
            description,
            mirror=None if cfg.symmetry == "none" else SymmetricAugmentation(MIRROR),
            optimizer=made.optimizer,
            guard=made.guard,
            num_env_states_per_minibatch=DATA.num_env_states_per_minibatch,
            num_minibatches=DATA.num_minibatches,
            tuning=TUNING if chained else LAYERED,
        )
        assert made.fused.layout.chained == chained
    return made


def finite(leaf):
    return leaf if leaf.dtype == torch.bool else leaf.nan_to_num(0.0, 0.0, 0.0)


def column(name):
    return importlib.import_module("ksim_rl.objectives.fused_ppo.step_kernels").SUMMARY.index(name)


def flat(state, path=""):
    if isinstance(state, dict):
        return {
            k: v for name, entry in state.items() for k, v in flat(entry, f"{path}/{name}").items()
        }
    return {path: torch.as_tensor(state)}


def assert_equal_states(one, other, *, atol=1e-4):
    one, other = flat(one.state_dict()), flat(other.state_dict())
    assert one.keys() == other.keys()
    for name, value in one.items():
        torch.testing.assert_close(
            value.float(),
            other[name].float(),
            atol=atol,
            rtol=1e-4,
            msg=lambda text, name=name: f"{name}: {text}",
        )


def to_eleven_bits(values):
    mantissa, exponent = torch.frexp(values)
    # Halves go away from zero, as in the instruction that converts.
    return torch.ldexp((mantissa.abs() * 2**11 + 0.5).floor().copysign(mantissa) / 2**11, exponent)
