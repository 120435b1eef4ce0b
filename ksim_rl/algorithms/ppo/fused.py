"""This module says whether the gradient steps of a PPO run can be fused kernels, and builds these for it."""

import importlib.util
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor, nn

from ksim_rl.data import DatasetBuffer, EpochSampler
from ksim_rl.modules import DiagonalGaussian, PolicyNetwork, ValueNetwork
from ksim_rl.modules.actor import MIN_STD, GaussianHead
from ksim_rl.modules.network import side_by_side
from ksim_rl.objectives import PPOCfg, StepGuard
from ksim_rl.objectives.fused_ppo import ACTIVATIONS, FusedNetworks, why_not_fused

if TYPE_CHECKING:
    from ksim_rl.objectives.fused_ppo.fused_ppo import FusedPPO


def make_fused_ppo(
    cfg: PPOCfg,
    *,
    actor: ProbabilisticTensorDictSequential,
    critic: TensorDictModuleBase,
    optimizer: torch.optim.Adam,
    guard: StepGuard,
    dataset: DatasetBuffer,
    device: torch.device,
) -> "FusedPPO | str":
    """Build the fused gradient steps of a run, or return why torch has to make them."""
    if device.type != "cuda" or importlib.util.find_spec("triton") is None:
        return "they need CUDA and Triton"
    if dataset.cfg.shards > 1:
        return "minibatches come from shards"
    if type(dataset.sampler) is not EpochSampler:
        return f"minibatches come from a {type(dataset.sampler).__name__}"
    networks = fused_networks(actor, critic)
    sizes: Any = {
        name: getattr(dataset.cfg, name) for name in ("num_env_states_per_minibatch", "num_minibatches")
    }
    reason = networks if isinstance(networks, str) else why_not_fused(cfg, networks, **sizes)
    if reason is not None:
        return reason
    assert isinstance(networks, FusedNetworks)
    # Triton is there only where CUDA is.
    from ksim_rl.objectives.fused_ppo.fused_ppo import FusedPPO

    return FusedPPO(
        cfg,
        networks,
        observe_actor=observer(actor[0]),
        observe_critic=observer(critic),
        optimizer=optimizer,
        guard=guard,
        **sizes,
    )


def fused_networks(
    actor: ProbabilisticTensorDictSequential, critic: TensorDictModuleBase
) -> FusedNetworks | str:
    """Return what the kernels need to know of `make_actor`'s and `make_critic`'s networks, or why they are others."""
    policy, value = getattr(actor[0], "module", None), getattr(critic, "module", None)
    if type(policy) is not PolicyNetwork or type(value) is not ValueNetwork:
        return "the networks are not those of make_actor and make_critic"
    head = policy.head
    if type(head) is not GaussianHead or head.std is None:
        return f"the policy is not a {DiagonalGaussian.__name__} whose std is the same in every state"
    layers = [*_layers(policy.trunk), head.loc], _layers(value.layers)
    activations = {type(part) for part in (*policy.trunk, *value.layers)} - {nn.Linear}
    if len(activations) != 1 or not activations <= {*ACTIVATIONS}:
        names = [sorted(kind.__name__ for kind in kinds) for kinds in (activations, ACTIVATIONS)]
        return f"the activations are {names[0]}, and not all one of {names[1]}"
    (activation,) = activations
    std = {"std_A": head.std, "log_std": head.std_type == "log", "min_std": MIN_STD}
    return FusedNetworks(actor=layers[0], critic=layers[1], activation=activation, **std)


def _layers(network: nn.Sequential) -> list[nn.Linear]:
    return [layer for layer in network if isinstance(layer, nn.Linear)]


def observer(module: Any) -> Callable[[TensorDictBase], Float[Tensor, "B L"]]:
    """Return what gives the input of the first layer of a network from `make_actor` or `make_critic`."""
    network: PolicyNetwork | ValueNetwork = module.module
    keys = list(module.in_keys)

    def observe(env_states: TensorDictBase) -> Float[Tensor, "*batch L"]:
        obs = side_by_side([env_states.get(key) for key in keys])
        return obs if network.normalizer is None else network.normalizer(obs)

    return observe
