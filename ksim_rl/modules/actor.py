"""This module builds the stochastic policy: normalization, an MLP and a distribution of the action."""

from jaxtyping import Float
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs.utils import ExplorationType
from torchrl.modules import ProbabilisticActor

from ksim_rl.modules.action_head import make_head
from ksim_rl.modules.heads import PARAMETERS, ActorCfg, MixedHead
from ksim_rl.modules.mlp import Device, mlp
from ksim_rl.modules.network import ObservingNetwork


class PolicyNetwork(ObservingNetwork):
    """Maps observations [..., L_i] to the parameters of the action's distribution.

    Attributes:
        head: the last layer, which also knows the distribution.
    """

    def __init__(self, cfg: ActorCfg, *, obs_dim: int, head: nn.Module, device: Device = None) -> None:
        super().__init__(cfg, obs_dim=obs_dim, device=device)
        self.trunk = mlp(obs_dim, cfg.hidden_dims, None, activation=cfg.activation, device=device)
        self.head = head

    def forward(self, *observations: Float[Tensor, "*batch ?L"]) -> tuple[Float[Tensor, "*batch ?N"], ...]:
        """Return the parameters, such as `(loc, scale)`, for observations that stand side by side."""
        return self.head(self.trunk(self.observe(*observations)))


def make_actor(
    cfg: ActorCfg,
    *,
    obs_dim: int,
    action_dim: int | None = None,
    action_spec: TensorSpec | None = None,
    device: Device = None,
) -> ProbabilisticActor:
    """Build the policy as TorchRL's `ProbabilisticActor`.

    It reads `cfg.in_keys` and writes the parameters of the distribution (`loc` and `scale`, or `logits`), `action` and
    `action_log_prob` [...]. Of several actions it writes each at its key, with `<key>_log_prob` beside it, and the
    parameters under `("params", *key)`: the layout of `CompositeDistribution`. It samples unless TorchRL's exploration
    type says otherwise; `ExplorationType.DETERMINISTIC` gives the mean, the median or the mode.

    Args:
        obs_dim: size of the last dim of the observations side by side.
        action_dim: where there is no spec: of one action without bounds.
        action_spec: the env's `full_action_spec`, or the spec of its one action.

    Raises:
        ValueError: if `cfg.distribution` does not go with the spec.
    """
    if action_spec is None:
        if action_dim is None:
            raise ValueError("make_actor needs action_spec, or action_dim")
        action_spec = Unbounded(action_dim)
    feature_dim = cfg.hidden_dims[-1] if cfg.hidden_dims else obs_dim
    # Drawn after the layers below it, so that one seed gives the same network whatever the head.
    network = PolicyNetwork(cfg, obs_dim=obs_dim, head=nn.Identity(), device=device)
    network.head, action_keys = make_head(cfg, action_spec, feature_dim, device=device)
    return make_probabilistic(network, list(cfg.in_keys), action_keys, action_spec)


def make_probabilistic(
    network: nn.Module, in_keys: list[NestedKey], action_keys: list[NestedKey], action_spec: TensorSpec | None
) -> ProbabilisticActor:
    """Wrap a network with a `head` from `make_head` as TorchRL's `ProbabilisticActor`."""
    head = network.head
    mixed = isinstance(head, MixedHead)
    parameter_keys = head.parameter_keys if mixed else list(head.parameter_names)  # type: ignore[union-attr,arg-type]
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=in_keys, out_keys=parameter_keys),
        in_keys=[PARAMETERS] if mixed else parameter_keys,
        out_keys=action_keys,
        spec=action_spec,
        # A method, so that the bounds are those of the head wherever it is moved or copied.
        distribution_class=head.distribution,  # type: ignore[union-attr,arg-type]
        return_log_prob=True,
        default_interaction_type=ExplorationType.RANDOM,
    )
