"""Builds any network for the observations of an env: vectors side by side, and pictures through their encoders."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torchrl.data import Composite

from ksim_rl.checks import naming
from ksim_rl.modules.encoders import Encoder
from ksim_rl.modules.mlp import Device
from ksim_rl.modules.network import (
    NetworkCfg,
    ObservationKey,
    check_unused,
    leaf_spec,
    observation_dim,
)
from ksim_rl.modules.recurrent import behind
from ksim_rl.modules.upstream import TensorModule
from ksim_rl.transforms.specs import spell

ENCODED = "encoded"

AnyNetwork = TypeVar("AnyNetwork", bound=TensorDictModuleBase)


def make_for_spec(
    make: Callable[..., AnyNetwork],
    cfg: NetworkCfg,
    spec: Composite,
    *,
    device: Device = None,
    **options: Any,
) -> AnyNetwork:
    """Build a network, by `make_actor` or another maker, for the observations of an env that its config reads.

    Pictures [..., H, W, C] go through the encoders of `cfg.encoders` first; their features, at ("encoded", name), stand
    behind the vectors. Each call makes encoders of its own; actor and critic share a trunk's. `options` are the
    maker's. Raises ValueError where an observation is missing, is no vector and has no encoder, or does not fit it.

    Example:
        >>> cfg = ActorCfg(in_keys=("wrist", "joints"), encoders={"wrist": EncoderCfg()})
        >>> actor = make_for_spec(make_actor, cfg, env.observation_spec, action_spec=env.full_action_spec)
    """
    vectors = [key for key in cfg.in_keys if spell(key) not in cfg.encoders]
    obs_dim = observation_dim(spec, vectors)
    if not cfg.encoders:
        return make(cfg, obs_dim=obs_dim, device=device, **options)
    check_unused(spec, ENCODED)
    encoders = []
    encoded_dim = 0
    for key in cfg.in_keys:
        if key not in vectors:
            encoder = _make_encoder(cfg, key, spec, device)
            encoded_dim += encoder.module.num_features
            encoders.append(encoder)
    # Vectors first: what is normalized stands in front.
    features = [encoder.out_keys[0] for encoder in encoders]
    cfg = replace(cfg, in_keys=(*vectors, *features), encoders={})
    network = make(
        cfg, obs_dim=obs_dim + encoded_dim, encoded_dim=encoded_dim, device=device, **options
    )
    for encoder in reversed(encoders):
        network = behind(encoder, network)
    return network


def _make_encoder(
    cfg: NetworkCfg, key: ObservationKey, spec: Composite, device: Device
) -> TensorDictModule:
    name = spell(key)
    with naming(f"encoders.{name}"):
        encoder = Encoder(cfg.encoders[name], leaf_spec(spec, key), device=device)
    return TensorModule(encoder, in_keys=[key], out_keys=[(ENCODED, name)])
