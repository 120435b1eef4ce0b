"""Decides whether the gradient steps of a PPO run can be fused kernels, and builds these for it."""

import importlib.util
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from ksim_rl.algorithms.gradient_steps import DatasetUpdate
from ksim_rl.data import EpochSampler
from ksim_rl.modules import DiagonalGaussian, Encoder, PolicyNetwork, TanhGaussian, ValueNetwork
from ksim_rl.modules.action_heads import GaussianHead, TanhGaussianHead
from ksim_rl.modules.upstream import TensorModule
from ksim_rl.objectives import SymmetricAugmentation
from ksim_rl.objectives.fused_ppo import ACTIVATIONS, FusedNetworks, why_not_fused
from ksim_rl.objectives.fused_ppo.layout import Observer
from ksim_rl.transforms import MirrorMap

if TYPE_CHECKING:
    from ksim_rl.objectives.fused_ppo.fused_ppo import FusedPPO


@dataclass(frozen=True)
class NotFused:
    """Says by `reason` why torch makes the gradient steps of a run, and no fused kernels."""

    reason: str


def make_fused_ppo(
    update: DatasetUpdate, mirror: Mapping[NestedKey, MirrorMap] | None = None
) -> "FusedPPO | NotFused":
    """Build the fused gradient steps of a PPO update, or say why torch has to make them."""
    # The cheap reasons first: device, and the way in which minibatches are drawn.
    if update.device.type != "cuda" or importlib.util.find_spec("triton") is None:
        return NotFused("they need CUDA and Triton")
    if update.dataset.cfg.shards > 1:
        return NotFused("minibatches come from shards")
    if type(update.dataset.sampler) is not EpochSampler:
        return NotFused(f"minibatches come from a {type(update.dataset.sampler).__name__}")
    cfg: Any = update.cfg
    actor, critic = [cast(Any, update.networks[name]) for name in ("actor", "critic")]
    networks = fused_networks(actor, critic)
    data = update.dataset.cfg
    sizes: Any = {
        name: getattr(data, name) for name in ("num_env_states_per_minibatch", "num_minibatches")
    }
    if isinstance(networks, NotFused):
        return networks
    # The description of the networks is there: now config, sizes and precision.
    reason = why_not_fused(cfg, networks, **sizes)
    if reason is not None:
        return NotFused(reason)
    # Triton is there only where CUDA is.
    from ksim_rl.objectives.fused_ppo.fused_ppo import FusedPPO

    read = [*actor[0].in_keys, *critic.in_keys]
    return FusedPPO(
        cfg,
        networks,
        mirror=None
        if cfg.symmetry == "none"
        else SymmetricAugmentation(mirror, read=read, device=update.device),
        optimizer=update.optimizer,
        guard=update.guard,
        **sizes,
    )


class FusedBehavior(ProbabilisticTensorDictSequential):
    """Acts as `actor`, with means that are bit for bit as in the first gradient step, by its chained kernels.

    The weights are taken from the actor at each call, or once where `steady` begins.
    """

    def __init__(self, actor: ProbabilisticTensorDictSequential, fused: "FusedPPO") -> None:
        parts: list[Any] = [*cast(Any, actor).module]
        network = parts[0].module
        # Only the first module of the actor is replaced; the others make the distribution and sample as before.
        keys = {"in_keys": parts[0].in_keys, "out_keys": parts[0].out_keys}

        def parameters_of(*observations: Tensor) -> tuple[Tensor, Tensor]:
            # Someone may have changed the weights between two calls.
            if not self._is_steady:
                self._fused.parameters.load()
            loc = self._fused.means(network.joined(*observations))
            return loc, network.head.scale().expand_as(loc)

        parts[0] = TensorModule(parameters_of, **keys)
        super().__init__(*parts)
        self._fused = fused
        self._is_steady = False

    @contextmanager
    def steady(self) -> Iterator[None]:
        """Take over the weights for all calls within, between which they stay."""
        self._fused.parameters.load()
        self._is_steady = True
        try:
            yield
        finally:
            self._is_steady = False


def fused_networks(
    actor: ProbabilisticTensorDictSequential, critic: TensorDictModuleBase
) -> FusedNetworks | NotFused:
    """Return the description of `make_actor`'s and `make_critic`'s networks for the kernels, or why they are others."""
    if any(isinstance(part, Encoder) for own in (actor, critic) for part in own.modules()):
        return NotFused("the networks read pictures")
    policy = getattr(actor[0], "module", None)
    value = getattr(critic, "module", None)
    # Exact types: a subclass may compute something else.
    if type(policy) is not PolicyNetwork or type(value) is not ValueNetwork:
        return NotFused("the networks were not made by make_actor and make_critic")
    if type(policy.trunk) is not nn.Sequential or type(value.layers) is not nn.Sequential:
        return NotFused("the networks are of layers of their own")
    head: Any = policy.head
    if type(head) not in (GaussianHead, TanhGaussianHead):
        return NotFused(f"the policy is no {DiagonalGaussian.__name__} or {TanhGaussian.__name__}")
    # The actor's head is its last layer; the std is handed over separately.
    layers = [*_layers(policy.trunk), head.loc], _layers(value.layers)
    # The kernels have one activation for all hidden layers.
    activations = {type(part) for part in (*policy.trunk, *value.layers)} - {nn.Linear}
    # Except for linear layers, nothing but one known activation may stand between the layers.
    if len(activations) != 1 or not activations <= {*ACTIVATIONS}:
        present = sorted(kind.__name__ for kind in activations)
        known = sorted(kind.__name__ for kind in ACTIVATIONS)
        return NotFused(f"the activations are {present}, and not all one of {known}")
    (activation,) = activations
    std: Any = {"std_A": head.std, "std_layer": head.std_layer, "log_std": head.std_type == "log"}
    return FusedNetworks(
        actor=layers[0],
        critic=layers[1],
        observers=(_observer(actor[0]), _observer(critic)),
        activation=activation,
        min_std=head.min_std,
        squashed=head.distribution if type(head) is TanhGaussianHead else None,
        **std,
    )


def _layers(network: nn.Sequential) -> list[nn.Linear]:
    return [layer for layer in network if isinstance(layer, nn.Linear)]


def _observer(module: Any) -> Observer:
    network: PolicyNetwork | ValueNetwork = module.module
    keys = list(module.in_keys)
    moments = network.normalizer
    return Observer(
        read=lambda env_states: network.joined(*(env_states.get(key) for key in keys)),
        moments=moments,
        eps=0.0 if moments is None else moments.eps,
    )
