"""This module has what the networks share: what they observe, its normalization, fields of their configs, a trunk."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Composite

from ksim_rl.checked import Checked, NonNegative
from ksim_rl.checks import check_in_range
from ksim_rl.device.running_moments import RunningMoments
from ksim_rl.modules.mlp import Device, check_network, mlp

ObservationKey = str | tuple[str, ...]


def checked_keys(keys: Sequence[ObservationKey]) -> tuple[ObservationKey, ...]:
    """Return the keys as hashable ones.

    Raises:
        ValueError: if there is none, or one is no name or sequence of names, or one comes twice.
    """
    if isinstance(keys, str) or not keys:
        raise ValueError(f"in_keys={keys!r}: expected a list of one observation group or more")
    checked: list[ObservationKey] = []
    for index, key in enumerate(keys):
        names = (key,) if isinstance(key, str) else tuple(key)
        if not names or not all(isinstance(name, str) and name for name in names):
            raise ValueError(
                f"in_keys[{index}]={key!r}: expected a name, or a list of names for a nested key"
            )
        checked.append(names[0] if len(names) == 1 else names)
    if len(set(checked)) < len(checked):
        raise ValueError(f"in_keys={tuple(checked)!r}: each key can be read once")
    return tuple(checked)


def observation_dim(spec: Composite, keys: Sequence[ObservationKey]) -> int:
    """Return the size of the last dim of the observations at `keys`, side by side.

    Raises:
        ValueError: if the spec lacks a key.
    """
    there = list(spec.keys(True, True))
    for key in keys:
        if key not in there:
            raise ValueError(f"in_keys: the env has no observation {key!r}; it has {sorted(map(str, there))}")
    return sum(spec[key].shape[-1] for key in keys)


def side_by_side(observations: Sequence[Float[Tensor, "*batch ?L"]]) -> Float[Tensor, "*batch L"]:
    """Join observations along their last dim."""
    return observations[0] if len(observations) == 1 else torch.cat(tuple(observations), -1)


class ObservationNormalizer(RunningMoments):
    """Shifts and scales observations by running statistics: `(x - mean) / sqrt(var + eps)`.

    `forward` never updates; `update` is called once per env state, after the policy update that used the old
    statistics, so that stored and recomputed action log-probabilities refer to the same policy. With several ranks all
    of them have to call it. Statistics are exact, and both methods can be captured in a CUDA graph: see
    `RunningMoments`.

    Args:
        dim: L, size of the last dim of observations.
        eps: added to the variance. The default bounds the standard deviation below by 0.01: a constant
            component stays small when it starts to move.
        until: stop updating once so many observations are counted; None never stops.
    """

    def __init__(
        self,
        dim: int,
        *,
        eps: float = 1e-4,
        until: int | None = None,
        device: Device = None,
    ) -> None:
        check_in_range("eps", eps, low=0.0, low_open=True)
        super().__init__(dim, until=until, device=device)
        self.eps = eps

    def forward(self, obs: Float[Tensor, "*batch L"]) -> Float[Tensor, "*batch L"]:
        """Normalize observations."""
        return (obs - self.mean) * torch.rsqrt(self.var + self.eps)

    def extra_repr(self) -> str:
        """Describe the module in its repr."""
        return f"dim={self.dim}, eps={self.eps}, until={self.until}"


def update_normalizers(
    tensordict: TensorDictBase, *networks: nn.Module, valid: Bool[Tensor, "*batch"] | None = None
) -> None:
    """Update each normalizer inside `networks` with the observations that its network reads.

    Call it once per dataset: a normalizer that two networks share, or that is listed twice, is updated once.

    Args:
        tensordict: the env states, e.g. a rollout `["E","T"]`.
        networks: actors, critics; any other `nn.Module` is searched for networks that own a `normalizer`.
        valid: env states marked False are left out.
    """
    seen: set[int] = set()
    for network in networks:
        for module in network.modules():
            normalizer = getattr(getattr(module, "module", None), "normalizer", None)
            if not isinstance(module, TensorDictModule) or not isinstance(normalizer, ObservationNormalizer):
                continue
            if id(normalizer) not in seen:
                seen.add(id(normalizer))
                normalizer.update(_observation(tensordict, module, normalizer.dim), valid)


def _observation(tensordict: TensorDictBase, module: TensorDictModule, dim: int) -> Tensor:
    """Return what a network normalizes: its first inputs, as many as make up `dim` numbers."""
    observations: list[Tensor] = []
    for key in module.in_keys:
        if sum(obs.shape[-1] for obs in observations) < dim:
            observations.append(tensordict.get(key))
    return side_by_side(observations)


@dataclass(frozen=True, kw_only=True)
class NetworkCfg(Checked):
    """The fields that the configs of all networks have.

    Attributes:
        hidden_dims: widths of the hidden layers.
        activation: one of `ksim_rl.modules.ACTIVATIONS`.
        obs_normalization: normalize observations by running statistics inside the network.
    """

    hidden_dims: tuple[int, ...] = (512, 256, 128)
    activation: str = "elu"
    obs_normalization: bool = True

    def __post_init__(self) -> None:
        """Check the fields, and keep what is hashable."""
        super().__post_init__()
        object.__setattr__(self, "hidden_dims", tuple(self.hidden_dims))
        check_network(self.hidden_dims, self.activation)


@dataclass(frozen=True, kw_only=True)
class OnPolicyNetworkCfg(NetworkCfg):
    """The fields of networks that choose what they read.

    Attributes:
        in_keys: the observation groups that it reads, side by side; a list names a nested key.
    """

    in_keys: tuple[ObservationKey, ...] = ("actor",)

    def __post_init__(self) -> None:
        """Check the fields, and keep what is hashable."""
        object.__setattr__(self, "in_keys", checked_keys(self.in_keys))
        super().__post_init__()


@dataclass(frozen=True, kw_only=True)
class OffPolicyNetworkCfg(NetworkCfg):
    """The fields of the networks of off-policy methods.

    Attributes:
        layer_norm: normalize before each activation.
        output_gain: scale of the last layer's weights; a small one lets the first policy act around the middle.
    """

    hidden_dims: tuple[int, ...] = (256, 256)
    activation: str = "relu"
    layer_norm: bool = False
    output_gain: NonNegative = 1.0

    def build(self, input_dim: int, output_dim: int, **options: Any) -> nn.Sequential:
        """Return the `mlp` of these fields; `options` are its others."""
        options |= {"layer_norm": self.layer_norm, "output_gain": self.output_gain}
        return mlp(input_dim, self.hidden_dims, output_dim, activation=self.activation, **options)


class ObservingNetwork(nn.Module):
    """The base of networks that normalize what they read.

    Attributes:
        normalizer: an `ObservationNormalizer`, or None.
    """

    def __init__(self, cfg: NetworkCfg, *, obs_dim: int, device: Device = None) -> None:
        super().__init__()
        self.normalizer = ObservationNormalizer(obs_dim, device=device) if cfg.obs_normalization else None

    def observe(self, *observations: Float[Tensor, "*batch ?L"]) -> Float[Tensor, "*batch L"]:
        """Return what the first layer reads: observations side by side, normalized."""
        obs = side_by_side(observations)
        return obs if self.normalizer is None else self.normalizer(obs)


FEATURES = "features"


@dataclass(frozen=True, kw_only=True)
class SharedTrunkCfg(OnPolicyNetworkCfg):
    """Layers below actor and critic, which read what they write: the key "features"."""

    hidden_dims: tuple[int, ...] = (512, 256)

    def __post_init__(self) -> None:
        """Refuse values out of range, naming the field."""
        super().__post_init__()
        if not self.hidden_dims:
            raise ValueError("hidden_dims=(): expected at least one width")


class TrunkNetwork(ObservingNetwork):
    """Maps observations [..., L_i] to features [..., L], L the last width."""

    def __init__(self, cfg: SharedTrunkCfg, *, obs_dim: int, device: Device = None) -> None:
        super().__init__(cfg, obs_dim=obs_dim, device=device)
        self.layers = mlp(obs_dim, cfg.hidden_dims, None, activation=cfg.activation, device=device)

    def forward(self, *observations: Float[Tensor, "*batch ?L"]) -> Float[Tensor, "*batch L"]:
        """Return the features for observations that stand side by side."""
        return self.layers(self.observe(*observations))


def make_shared_trunk(cfg: SharedTrunkCfg, *, obs_dim: int, device: Device = None) -> TensorDictModule:
    """Build the layers as a TensorDict module, the common part of TorchRL's `ActorValueOperator`.

    Reads `cfg.in_keys`, `obs_dim` numbers side by side, and writes "features" [..., L].
    """
    network = TrunkNetwork(cfg, obs_dim=obs_dim, device=device)
    return TensorDictModule(network, in_keys=list(cfg.in_keys), out_keys=[FEATURES])
