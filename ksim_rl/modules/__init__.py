"""The networks: actor, critic and the parts that they are made of, each a TorchRL or torch module."""

from ksim_rl.modules.actor import PolicyNetwork, make_actor
from ksim_rl.modules.actor_cfg import ActorCfg
from ksim_rl.modules.bounded_actors import (
    DeterministicActorCfg,
    SquashedActorCfg,
    make_deterministic_actor,
    make_squashed_actor,
)
from ksim_rl.modules.carried_state import CarriedState, burnt_in
from ksim_rl.modules.categorical import Categorical
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
from ksim_rl.modules.distributions import DiagonalGaussian, TanhGaussian, TruncatedGaussian
from ksim_rl.modules.encoders import Encoder, EncoderCfg, SpatialSoftmax, picture_encoders
from ksim_rl.modules.make_for_spec import make_for_spec
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
    RecurrentCfg,
    RecurrentModule,
    RecurrentNetwork,
    RecurrentStatePrimer,
    behind,
    make_recurrent_actor,
    make_recurrent_critic,
    recurrent_modules,
    recurrent_transforms,
    state_spec,
)
