"""Builds stochastic policies: normalization, an MLP, and the head that an env's actions need."""

from jaxtyping import Float, Num
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs.utils import ExplorationType
from torchrl.modules import ProbabilisticActor

from ksim_rl.modules.action_heads import PARAMETERS, MixedHead, make_head
from ksim_rl.modules.actor_cfg import ActorCfg
from ksim_rl.modules.mlp import Device
from ksim_rl.modules.network import ObservingNetwork, built
from ksim_rl.modules.upstream import TensorModule


class PolicyNetwork(ObservingNetwork):
    """Maps observations [..., L_i] to the parameters of the action's distribution, which its `head` knows."""

    def __init__(
        self,
        cfg: ActorCfg,
        *,
        obs_dim: int,
        head: nn.Module,
        encoded_dim: int = 0,
        device: Device = None,
    ) -> None:
        super().__init__(cfg, obs_dim=obs_dim, encoded_dim=encoded_dim, device=device)
        self.trunk, self.feature_dim = built(cfg, obs_dim, None, device=device)
        self.head = head

    def forward(
        self, *observations: Num[Tensor, "*batch ?L"]
    ) -> tuple[Float[Tensor, "*batch ?N"], ...]:
        """Return the parameters, such as `(loc, scale)`, for observations that stand side by side."""
        return self.head(self.trunk(self.observe(*observations)))


def make_actor(
    cfg: ActorCfg,
    *,
    obs_dim: int,
    encoded_dim: int = 0,
    action_dim: int | None = None,
    action_spec: TensorSpec | None = None,
    device: Device = None,
) -> ProbabilisticActor:
    """Build the policy as TorchRL's `ProbabilisticActor`.

    It reads `cfg.in_keys`, `obs_dim` numbers side by side, the last `encoded_dim` of them features of encoders: see
    `make_for_spec`. It writes the parameters of the distribution (`loc` and `scale`, or `logits`), `action` and
    `action_log_prob` [...]. Of several actions it writes each at its key, with `<key>_log_prob`, and the parameters
    under `("params", *key)`: the layout of `CompositeDistribution`. It samples unless TorchRL's exploration type says
    otherwise; `ExplorationType.DETERMINISTIC` gives the mean, the median or the mode. `action_spec` is the env's
    `full_action_spec`, or the spec of its one action; `action_dim` stands for one action without bounds. Raises
    ValueError where `cfg.distribution` does not go with the spec.
    """
    if action_spec is None:
        if action_dim is None:
            raise ValueError("make_actor needs action_spec, or action_dim")
        action_spec = Unbounded(action_dim)
    # Drawn after the layers below it, so that one seed gives the same network whatever the head.
    network = PolicyNetwork(
        cfg, obs_dim=obs_dim, encoded_dim=encoded_dim, head=nn.Identity(), device=device
    )
    network.head, action_keys = make_head(cfg, action_spec, network.feature_dim, device=device)
    return make_probabilistic(network, list(cfg.in_keys), action_keys, action_spec)


def make_probabilistic(
    network: nn.Module,
    in_keys: list[NestedKey],
    action_keys: list[NestedKey],
    action_spec: TensorSpec | None,
) -> ProbabilisticActor:
    """Wrap a network with a `head` from `make_head` as TorchRL's `ProbabilisticActor`."""
    head = network.head
    mixed = isinstance(head, MixedHead)
    # A single action has its parameters at the root, several have them nested under "params".
    parameter_keys = head.parameter_keys if mixed else list(head.parameter_names)  # type: ignore[union-attr,arg-type]
    return ProbabilisticActor(
        TensorModule(network, in_keys=in_keys, out_keys=parameter_keys),
        in_keys=[PARAMETERS] if mixed else parameter_keys,
        out_keys=action_keys,
        spec=action_spec,
        # A method, so that the bounds are the head's wherever it is moved or copied.
        distribution_class=head.distribution,  # type: ignore[union-attr,arg-type]
        return_log_prob=True,
        default_interaction_type=ExplorationType.RANDOM,
    )
