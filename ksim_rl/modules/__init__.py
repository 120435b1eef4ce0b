"""Networks: the actor, the critic and the parts that they are made of, each a TorchRL or torch module."""

from ksim_rl.modules.actor import PolicyNetwork, make_actor
from ksim_rl.modules.actor_cfg import ActorCfg
from ksim_rl.modules.bounded_actors import (
    DeterministicActorCfg,
    SquashedActorCfg,
    make_deterministic_actor,
    make_squashed_actor,
)
from ksim_rl.modules.categorical import Categorical
from ksim_rl.modules.critic import CriticCfg, ValueNetwork, make_critic
from ksim_rl.modules.diagonal_gaussian import DiagonalGaussian
from ksim_rl.modules.exploring_policy import ExploringPolicy
from ksim_rl.modules.mlp import ACTIVATIONS, mlp
from ksim_rl.modules.observation_normalizer import ObservationNormalizer, update_normalizers
from ksim_rl.modules.q_network import QNetwork, QNetworkCfg, make_q_network
from ksim_rl.modules.tanh_gaussian import TanhGaussian
from ksim_rl.modules.truncated_gaussian import TruncatedGaussian

__all__ = [
    "ACTIVATIONS",
    "ActorCfg",
    "Categorical",
    "CriticCfg",
    "DeterministicActorCfg",
    "DiagonalGaussian",
    "ExploringPolicy",
    "ObservationNormalizer",
    "PolicyNetwork",
    "QNetwork",
    "QNetworkCfg",
    "SquashedActorCfg",
    "TanhGaussian",
    "TruncatedGaussian",
    "ValueNetwork",
    "make_actor",
    "make_critic",
    "make_deterministic_actor",
    "make_q_network",
    "make_squashed_actor",
    "mlp",
    "update_normalizers",
]
