"""This room has the networks: actor, critic and the parts that they are made of, each a TorchRL or torch module."""

from ksim_rl.modules.actor import ActorCfg, PolicyNetwork, make_actor
from ksim_rl.modules.bounded_actors import (
    DeterministicActorCfg,
    SquashedActorCfg,
    make_deterministic_actor,
    make_squashed_actor,
)
from ksim_rl.modules.collecting_policies import ExploringPolicy, MixedPolicy
from ksim_rl.modules.critic import (
    CriticCfg,
    Discriminator,
    QNetwork,
    QNetworkCfg,
    ValueNetwork,
    make_critic,
    make_q_network,
)
from ksim_rl.modules.distributions import Categorical, DiagonalGaussian, TanhGaussian, TruncatedGaussian
from ksim_rl.modules.mlp import ACTIVATIONS, mlp
from ksim_rl.modules.network import (
    FEATURES,
    ObservationKey,
    ObservationNormalizer,
    SharedTrunkCfg,
    make_shared_trunk,
    observation_dim,
    update_normalizers,
)
from ksim_rl.modules.recurrent import (
    CarriedState,
    RecurrentCfg,
    RecurrentModule,
    RecurrentNetwork,
    RecurrentStatePrimer,
    behind,
    burnt_in,
    make_recurrent_actor,
    make_recurrent_critic,
    recurrent_modules,
    recurrent_transforms,
    state_spec,
)

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
    "behind",
    "burnt_in",
    "make_actor",
    "make_critic",
    "make_recurrent_actor",
    "make_recurrent_critic",
    "make_deterministic_actor",
    "make_q_network",
    "make_shared_trunk",
    "make_squashed_actor",
    "mlp",
    "observation_dim",
    "recurrent_modules",
    "recurrent_transforms",
    "state_spec",
    "update_normalizers",
]
