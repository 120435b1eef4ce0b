"""Networks: the actor, the critic and the parts that they are made of, each a TorchRL or torch module."""

from ksim_rl.modules.actor import ActorCfg, GaussianPolicy, make_actor
from ksim_rl.modules.critic import CriticCfg, ValueNetwork, make_critic
from ksim_rl.modules.diagonal_gaussian import DiagonalGaussian
from ksim_rl.modules.mlp import ACTIVATIONS, mlp
from ksim_rl.modules.observation_normalizer import ObservationNormalizer, update_normalizers

__all__ = [
    "ACTIVATIONS",
    "ActorCfg",
    "CriticCfg",
    "DiagonalGaussian",
    "GaussianPolicy",
    "ObservationNormalizer",
    "ValueNetwork",
    "make_actor",
    "make_critic",
    "mlp",
    "update_normalizers",
]
