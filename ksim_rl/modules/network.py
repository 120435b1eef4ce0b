"""The parts that networks share: observations, their normalization, fields of configs, a trunk."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import torch
from jaxtyping import Float, Num
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec, Unbounded

from ksim_rl.checked import Checked, Count, Filled, Name, NonNegative, numbers_of_layers
from ksim_rl.checks import check_choice, check_in_range, near
from ksim_rl.modules.encoders import EncoderCfg
from ksim_rl.modules.mlp import ACTIVATIONS, Device, mlp
from ksim_rl.modules.upstream import TensorModule
from ksim_rl.ranks.running_moments import RunningMoments, publish
from ksim_rl.transforms.specs import spell

ObservationKey = str | tuple[str, ...]
_NestedKey = Annotated[
    tuple[Name, ...], Filled("expected a name, or a list of names for a nested key")
]
ObservationKeys = Annotated[
    tuple[Name | _NestedKey, ...], Filled("expected one observation group or more")
]


def leaf_spec(spec: Composite, key: ObservationKey) -> TensorSpec:
    """Return shape and dtype of an observation, without batch dims; ValueError where there is none."""
    there = list(spec.keys(True, True))
    if key not in there:
        raise ValueError(
            f"in_keys: the env has no observation {key!r}; it has {sorted(map(str, there))}"
        )
    leaf = spec[key]
    # A nested TensorDict may have more batch dims than the env, such as one of agents.
    if isinstance(key, tuple):
        batch_dims = spec[key[:-1]].ndim
    else:
        batch_dims = spec.ndim
    return Unbounded(leaf.shape[batch_dims:], dtype=leaf.dtype)


def check_unused(spec: Composite, key: str) -> None:
    """Refuse an env that shows an observation at a key where networks write: it would be lost."""
    if key in spec.keys():
        raise ValueError(
            f"the env has an observation {key!r}, where networks write their features: give it another name"
        )


def observation_dim(spec: Composite, keys: Sequence[ObservationKey]) -> int:
    """Return the sum of the sizes of the observations at `keys`, which stand side by side.

    ValueError where one is missing, or is no vector: a network would read a picture as so many rows of numbers.
    """
    total = 0
    for key in keys:
        leaf = leaf_spec(spec, key)
        if leaf.ndim != 1 or leaf.dtype == torch.uint8:
            raise ValueError(
                f"in_keys: {key!r} is no vector of numbers, but {leaf.dtype} of shape {list(leaf.shape)} in each env: "
                f"a picture needs an encoder, `encoders: {{{spell(key)}: {{}}}}`; other shapes have to be flattened by "
                "a transform"
            )
        total += leaf.shape[0]
    return total


def side_by_side(observations: Sequence[Float[Tensor, "*batch ?L"]]) -> Float[Tensor, "*batch L"]:
    """Join observations along their last dim."""
    if len(observations) == 1:
        return observations[0]
    return torch.cat(tuple(observations), -1)


class ObservationNormalizer(RunningMoments):
    """Shifts and scales observations by running statistics: `(x - mean) / sqrt(var + eps)`.

    `forward` never updates; `update` is called once per env state, after the policy update that used the old
    statistics, so that stored and recomputed action log-probabilities refer to the same policy. With several ranks all
    of them have to call it. Statistics are exact, and both methods can be captured in a CUDA graph: see
    `RunningMoments`. They stop once `until` observations are counted. The default of `eps` bounds the standard
    deviation below by 0.01: a constant component stays small when it starts to move.

    The last `encoded_dim` numbers of what it reads are features of encoders, beyond the `dim` that it normalizes, and
    stay as they are: statistics of what is learned would describe networks that are long gone.
    """

    def __init__(
        self,
        dim: int,
        *,
        encoded_dim: int = 0,
        eps: float = 1e-4,
        until: int | None = None,
        device: Device = None,
    ) -> None:
        # Zero would divide a component that never moves by zero.
        check_in_range("eps", eps, low=0.0, low_open=True)
        super().__init__(dim, until=until, device=device)
        self.eps = eps
        self.encoded_dim = encoded_dim

    def forward(self, obs: Float[Tensor, "*batch L"]) -> Float[Tensor, "*batch L"]:
        """Normalize observations."""
        if not self.encoded_dim:
            return self.normalized(obs, self.eps)
        measured, encoded = obs.split((self.dim, self.encoded_dim), dim=-1)
        return torch.cat((self.normalized(measured, self.eps), encoded), -1)

    def extra_repr(self) -> str:
        """Describe the module in its repr."""
        return f"dim={self.dim}, eps={self.eps}, until={self.until}"


def make_normalizer(
    is_wanted: bool, obs_dim: int, encoded_dim: int, device: Device
) -> ObservationNormalizer | None:
    """Build the normalizer of a network whose last `encoded_dim` inputs are features, or None where it has none."""
    # Features alone leave nothing to normalize.
    if not is_wanted or obs_dim == encoded_dim:
        return None
    return ObservationNormalizer(obs_dim - encoded_dim, encoded_dim=encoded_dim, device=device)


def update_normalizers(tensordict: TensorDictBase, *networks: nn.Module) -> None:
    """Update each normalizer inside `networks` once, with the observations that its network reads.

    Networks are actors, critics, or any other modules, which are searched for owners of a `normalizer`.
    """
    # A normalizer that several networks share counts each env state once.
    seen: dict[int, ObservationNormalizer] = {}
    for network in networks:
        for module in network.modules():
            # A TensorDict module holds the network as its `module`: only it knows the keys of the observations.
            normalizer = getattr(getattr(module, "module", None), "normalizer", None)
            if not isinstance(module, TensorDictModule) or not isinstance(
                normalizer, ObservationNormalizer
            ):
                continue
            if id(normalizer) not in seen:
                seen[id(normalizer)] = normalizer
                # Step by step, as the memory of a rollout is.
                normalizer.count_rows(
                    _observation(tensordict, module, normalizer.dim).transpose(0, -2)
                )
    # All at the end: ranks merge all statistics in one collective.
    publish([*seen.values()])


def _observation(tensordict: TensorDictBase, module: TensorDictModule, dim: int) -> Tensor:
    """Return the observations that a network normalizes: its first inputs, up to `dim` numbers."""
    observations: list[Tensor] = []
    for key in module.in_keys:
        # A critic of actions reads the action last, which its normalizer does not cover.
        if sum(obs.shape[-1] for obs in observations) < dim:
            observations.append(tensordict.get(key))
    return side_by_side(observations)


def _hashable(key: str | Sequence[str]) -> str | tuple[str, ...]:
    """Return a key as a TensorDict has it: a text, or a tuple of two or more."""
    if isinstance(key, str):
        return key
    # A list of one name is that name, as TensorDict would have it.
    parts = tuple(key)
    if len(parts) == 1:
        return parts[0]
    return parts


@dataclass(frozen=True, kw_only=True)
class NetworkCfg(Checked):
    """The fields of the configs of all networks, which can normalize observations by running statistics inside.

    A subclass with a `build` of its own makes any network of it, and configs name it by `_target_`.

    Attributes:
        in_keys: observation groups, read side by side; a list of names is a nested key.
        hidden_dims: widths of the hidden layers.
        activation: between the layers.
        obs_normalization: shift and scale observations by running statistics, but for pictures, which encoders scale.
        encoders: by the name of an observation that is a picture, what makes features of it; see `make_for_spec`.
    """

    in_keys: ObservationKeys = ("actor",)
    hidden_dims: tuple[Count, ...] = (512, 256, 128)
    activation: str = "elu"
    obs_normalization: bool = True
    encoders: Mapping[str, EncoderCfg] = field(default_factory=dict)

    def _check_fields(self) -> None:
        super()._check_fields()
        # The class is frozen; a config file gives a list.
        object.__setattr__(self, "hidden_dims", tuple(self.hidden_dims))
        check_choice("activation", self.activation, ACTIVATIONS)
        keys = tuple(_hashable(key) for key in self.in_keys)
        # Read twice, an observation would count twice in `obs_dim`, by mistake more likely than by intent.
        if len(set(keys)) < len(keys):
            raise ValueError(f"in_keys={keys!r}: each key can be read once")
        object.__setattr__(self, "in_keys", keys)
        # An encoder of what the network does not read would do nothing.
        read = [spell(key) for key in keys]
        for name in self.encoders:
            if name not in read:
                raise ValueError(f"encoders={name!r}: in_keys={read} lacks it: {near(name, read)}")

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return what the hidden layers need."""
        return {("hidden_dims",): numbers_of_layers(self.hidden_dims)}

    def build(self, input_dim: int, output_dim: int | None, **options: Any) -> nn.Module:
        """Return the layers, which map [..., input_dim] to [..., output_dim]: here an `mlp` of these fields.

        Without `output_dim`, as an actor needs them below its head, they give features of any width. `options` are
        others of `mlp`: "device", where the weights belong, and perhaps "output_gain", "layer_norm" and "num_networks".
        """
        return mlp(input_dim, self.hidden_dims, output_dim, activation=self.activation, **options)


def built(
    cfg: NetworkCfg, input_dim: int, output_dim: int | None, **options: Any
) -> tuple[nn.Module, int]:
    """Return the layers that a config builds, and the width of their outputs.

    A ValueError tells where they give another shape than [..., output_dim].
    """
    layers = cfg.build(input_dim, output_dim, **options)
    maker = f"{type(cfg).__name__}.build(input_dim={input_dim}, output_dim={output_dim})"
    if not isinstance(layers, nn.Module):
        raise ValueError(f"{maker} returns a {type(layers).__name__}: expected a torch.nn.Module")
    # Tried on two rows; statistics of batches stay as they are.
    layers.eval()
    try:
        with torch.no_grad():
            outputs = layers(torch.zeros(2, input_dim, device=options.get("device")))
    except (RuntimeError, TypeError, ValueError) as error:
        raise ValueError(
            f"{maker}: it cannot map observations [2, {input_dim}]: {error}"
        ) from error
    finally:
        layers.train()
    expected = "[2, number of features]" if output_dim is None else f"[2, {output_dim}]"
    if not isinstance(outputs, Tensor):
        raise ValueError(f"{maker}: it gives a {type(outputs).__name__}, and no tensor {expected}")
    fits = outputs.ndim == 2 and len(outputs) == 2 and output_dim in (None, outputs.shape[-1])
    if not fits:
        raise ValueError(
            f"{maker}: it maps [2, {input_dim}] to {list(outputs.shape)}: expected {expected}"
        )
    return layers, outputs.shape[-1]


@dataclass(frozen=True, kw_only=True)
class OffPolicyNetworkCfg(NetworkCfg):
    """The fields of the networks of off-policy methods; `output_gain` scales the last layer's weights."""

    hidden_dims: tuple[Count, ...] = (256, 256)
    activation: str = "relu"
    layer_norm: bool = False  # normalize before each activation
    output_gain: NonNegative = 1.0  # scale of the last layer's weights

    def build(self, input_dim: int, output_dim: int | None, **options: Any) -> nn.Module:
        """Return the layers: see `NetworkCfg.build`."""
        options |= {"layer_norm": self.layer_norm, "output_gain": self.output_gain}
        return super().build(input_dim, output_dim, **options)


class ObservingNetwork(nn.Module):
    """The base of networks that normalize their observations by their `normalizer`, if they have one.

    The last `encoded_dim` of the `obs_dim` numbers that they read are features of encoders.
    """

    def __init__(
        self, cfg: NetworkCfg, *, obs_dim: int, encoded_dim: int = 0, device: Device = None
    ) -> None:
        super().__init__()
        if cfg.encoders:
            raise ValueError(
                f"encoders={sorted(cfg.encoders)}: a network reads numbers; `make_for_spec` puts encoders in front"
            )
        self.obs_dim = obs_dim
        # The normalizer is part of the network, so that checkpoints and exports have it without further work.
        self.normalizer = make_normalizer(cfg.obs_normalization, obs_dim, encoded_dim, device)

    def observe(self, *observations: Num[Tensor, "*batch ?L"]) -> Float[Tensor, "*batch L"]:
        """Return the inputs of the first layer: observations side by side, normalized."""
        obs = self.joined(*observations)
        if self.normalizer is None:
            return obs
        return self.normalizer(obs)

    def joined(self, *observations: Num[Tensor, "*batch ?L"]) -> Float[Tensor, "*batch L"]:
        """Return observations side by side; a ValueError for pictures, or other numbers than it was built for."""
        for obs in observations:
            # A picture whose width or number of channels is `obs_dim` would be taken for many vectors.
            if obs.dtype == torch.uint8:
                raise ValueError(
                    f"the network reads numbers, and no uint8 of shape {list(obs.shape)}: build it with an encoder for "
                    "pictures, by `make_for_spec`"
                )
        obs = side_by_side(observations)
        if obs.shape[-1] != self.obs_dim:
            raise ValueError(
                f"the network was built for obs_dim={self.obs_dim}, and reads observations of {obs.shape[-1]} numbers"
            )
        return obs


FEATURES = "features"


@dataclass(frozen=True, kw_only=True)
class SharedTrunkCfg(NetworkCfg):
    """Layers below actor and critic, which read the outputs of these layers at "features"."""

    hidden_dims: Annotated[tuple[Count, ...], Filled("expected at least one width")] = (512, 256)


class LayeredNetwork(ObservingNetwork):
    """Maps observations [..., L_i] to the outputs of the layers that the config builds; `options` are for `build`."""

    def __init__(
        self,
        cfg: NetworkCfg,
        *,
        obs_dim: int,
        output_dim: int | None,
        encoded_dim: int = 0,
        device: Device = None,
        **options: Any,
    ) -> None:
        super().__init__(cfg, obs_dim=obs_dim, encoded_dim=encoded_dim, device=device)
        self.layers, self.output_dim = built(cfg, obs_dim, output_dim, device=device, **options)

    def forward(self, *observations: Num[Tensor, "*batch ?L"]) -> Float[Tensor, "*batch M"]:
        """Return the outputs for observations that stand side by side."""
        return self.layers(self.observe(*observations))


def make_shared_trunk(
    cfg: SharedTrunkCfg, *, obs_dim: int, encoded_dim: int = 0, device: Device = None
) -> TensorDictModule:
    """Build the layers that write "features" [..., L], the common part of TorchRL's `ActorValueOperator`."""
    network = LayeredNetwork(
        cfg, obs_dim=obs_dim, encoded_dim=encoded_dim, output_dim=None, device=device
    )
    return TensorModule(network, in_keys=list(cfg.in_keys), out_keys=[FEATURES])
