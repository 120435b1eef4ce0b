"""This module has the last layers of a policy with several actions, such as joint targets and a choice of gait."""

from collections.abc import Mapping
from typing import Any

from jaxtyping import Float
from tensordict import TensorDictBase
from tensordict.nn import CompositeDistribution
from tensordict.utils import NestedKey
from torch import Tensor, nn

PARAMETERS = "params"


class MixedHead(nn.Module):
    """Maps features [..., L] to the parameters of each action's distribution; the actions are independent.

    Args:
        heads: by key of the action in the env's action spec, each with `parameter_names` and `distribution`.
    """

    def __init__(self, heads: Mapping[NestedKey, nn.Module]) -> None:
        super().__init__()
        self.action_keys = list(heads)
        self.heads = nn.ModuleList(heads.values())

    @property
    def parameter_keys(self) -> list[NestedKey]:
        """Where the parameters go: `("params", *action key, name)`."""
        return [
            (PARAMETERS, *_path(key), name)
            for key, head in zip(self.action_keys, self.heads, strict=True)
            for name in head.parameter_names  # type: ignore[union-attr]
        ]

    def forward(self, features: Float[Tensor, "*batch L"]) -> tuple[Float[Tensor, "*batch ?N"], ...]:
        """Return the parameters in the order of `parameter_keys`."""
        return tuple(parameter for head in self.heads for parameter in head(features))

    def distribution(self, params: TensorDictBase) -> CompositeDistribution:
        """Return the distribution of all actions; `params` is what stands under "params"."""
        parts: dict[Any, Any] = {}
        for key, head in zip(self.action_keys, self.heads, strict=True):
            parameters = {name: params.get((*_path(key), name)) for name in head.parameter_names}  # type: ignore[union-attr]
            parts[key] = head.distribution(**parameters)  # type: ignore[operator]
        return CompositeDistribution.from_distributions(params, parts)


def _path(key: NestedKey) -> tuple[Any, ...]:
    return (key,) if isinstance(key, str) else tuple(key)
