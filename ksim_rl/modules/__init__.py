"""This room has the networks: actor, critic and the parts that they are made of, each a TorchRL or torch module."""

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
from ksim_rl.modules.discriminator import Discriminator
from ksim_rl.modules.exploring_policy import ExploringPolicy
from ksim_rl.modules.mixed_policy import MixedPolicy
from ksim_rl.modules.mlp import ACTIVATIONS, mlp
from ksim_rl.modules.observation_keys import ObservationKey, observation_dim
from ksim_rl.modules.observation_normalizer import ObservationNormalizer, update_normalizers
from ksim_rl.modules.q_network import QNetwork, QNetworkCfg, make_q_network
from ksim_rl.modules.recurrent import (
    RecurrentCfg,
    RecurrentModule,
    RecurrentNetwork,
    make_recurrent_actor,
    make_recurrent_critic,
    memories,
    state_spec,
    with_memory,
)
from ksim_rl.modules.recurrent_primer import RecurrentStatePrimer, recurrent_transforms
from ksim_rl.modules.recurrent_state import CarriedState, burnt_in
from ksim_rl.modules.shared_trunk import FEATURES, SharedTrunkCfg, make_shared_trunk
from ksim_rl.modules.tanh_gaussian import TanhGaussian
from ksim_rl.modules.truncated_gaussian import TruncatedGaussian

__all__ = [
    "ACTIVATIONS",
    "FEATURES",
    "ActorCfg",
    "CarriedState",
    "Categorical",
    "CriticCfg",
    "DeterministicActorCfg",
    "DiagonalGaussian",
    "Discriminator",
    "ExploringPolicy",
    "MixedPolicy",
    "ObservationKey",
    "ObservationNormalizer",
    "PolicyNetwork",
    "QNetwork",
    "QNetworkCfg",
    "RecurrentCfg",
    "RecurrentModule",
    "RecurrentNetwork",
    "RecurrentStatePrimer",
    "SharedTrunkCfg",
    "SquashedActorCfg",
    "TanhGaussian",
    "TruncatedGaussian",
    "ValueNetwork",
    "burnt_in",
    "make_actor",
    "make_critic",
    "make_recurrent_actor",
    "make_recurrent_critic",
    "make_deterministic_actor",
    "make_q_network",
    "make_shared_trunk",
    "make_squashed_actor",
    "memories",
    "mlp",
    "observation_dim",
    "recurrent_transforms",
    "state_spec",
    "update_normalizers",
    "with_memory",
]
