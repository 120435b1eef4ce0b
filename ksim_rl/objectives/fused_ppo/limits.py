"""This module says what the fused kernels cannot do."""

from typing import Protocol

from ksim_rl.objectives.fused_ppo.layout import FusedNetworks
from ksim_rl.objectives.ppo_cfg import PPOCfg

MAX_OBS = 256
MAX_ACTIONS = 64
# The second hidden layer is held in registers as a whole; the others are computed in chunks.
SECOND_WIDTHS = (16, 32, 64, 128, 256)
WIDTH_STEP = 16
MAX_PLACES = 2**31


class MinibatchSizes(Protocol):
    """Sizes of dataset and minibatch, as `DatasetCfg` has them."""

    @property
    def num_env_states_per_minibatch(self) -> int:
        """B."""
        ...

    @property
    def num_env_states(self) -> int:
        """D."""
        ...


def why_not_fused(cfg: PPOCfg, networks: FusedNetworks, *, data: MinibatchSizes) -> str | None:
    """Return why the kernels cannot make the gradient steps of `cfg`, or None if they can."""
    if cfg.kernels == "torch":
        return "kernels='torch'"
    if cfg.precision == "float32":
        # As TF32 they would be no faster than torch's.
        return "precision='float32', and the kernels multiply bfloat16"
    refused = {
        "advantage": cfg.advantage != "gae",
        "estimate_each_epoch": cfg.estimates_each_epoch,
        "symmetry": cfg.symmetry != "none",
        "normalize_advantage": cfg.normalize_advantage == "minibatch",
    }
    for field, is_set in refused.items():
        if is_set:
            return f"{field}={getattr(cfg, field)!r}"
    return _shape_reason(networks) or _size_reason(networks, data)


def _shape_reason(networks: FusedNetworks) -> str | None:
    hidden = [layer.out_features for layer in networks.actor[:-1]]
    if hidden != [layer.out_features for layer in networks.critic[:-1]] or len(hidden) != 3:
        return "actor and critic do not both have the same three hidden layers"
    if hidden[1] not in SECOND_WIDTHS or any(width % WIDTH_STEP for width in hidden):
        return (
            f"hidden_dims={tuple(hidden)}: the second must be one of {SECOND_WIDTHS}, the others multiples "
            f"of {WIDTH_STEP}"
        )
    widest = max(networks.actor[0].in_features, networks.critic[0].in_features)
    if widest > MAX_OBS or networks.actor[-1].out_features > MAX_ACTIONS:
        return f"there are more than {MAX_OBS} observations or {MAX_ACTIONS} actions"
    return None


def _size_reason(networks: FusedNetworks, data: MinibatchSizes) -> str | None:
    columns = sum(layer.out_features for layer in networks.actor) + MAX_OBS
    if (
        data.num_env_states_per_minibatch * columns >= MAX_PLACES
        or data.num_env_states * MAX_OBS >= MAX_PLACES
    ):
        return f"{data.num_env_states_per_minibatch} env states in a minibatch are too many"
    return None
