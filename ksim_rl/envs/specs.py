"""Makes the specs of an env: shapes, dtypes and dim names of its inputs and outputs, `["E"]`."""

from collections.abc import Mapping

import torch
from jaxtyping import Float, Shaped
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded

from ksim_rl import dims


def make_specs(
    readings: Mapping[str, Mapping[str, Shaped[Tensor, " E *?leaf"]]],
    size: int,
    bounds_L2: Float[Tensor, "L 2"] | None,
    *,
    batch_size: torch.Size,
    device: torch.device | None,
) -> tuple[Composite, Composite, Composite, Composite]:
    """Return the specs of observation, action, reward and done.

    `readings` are the observations by group and name, without empty groups; the action has `size` entries,
    between bounds (low, high) if there are any.
    """

    def composite(leaves: Mapping[str, object]) -> Composite:
        return Composite(dict(leaves), shape=batch_size, device=device)

    def unbounded(value: Shaped[Tensor, "*shape"]) -> Unbounded:
        return Unbounded(shape=value.shape, dtype=value.dtype, device=device)

    # An env without commands has no empty "command" in its specs.
    groups = {
        group: composite({name: unbounded(value) for name, value in values.items()})
        for group, values in readings.items()
        if values
    }
    # Shapes with the batch dim, as specs of an env have them.
    shape_E1 = torch.Size((*batch_size, 1))
    shape_EL = torch.Size((*batch_size, size))
    # Only where all columns have bounds; see `ActionManager`.
    action: Unbounded | Bounded = Unbounded(shape=shape_EL, device=device)
    if bounds_L2 is not None:
        low_EL, high_EL = (edge_L.expand(shape_EL).clone() for edge_L in bounds_L2.unbind(-1))
        action = Bounded(low_EL, high_EL, shape=shape_EL, dtype=torch.float32, device=device)
    # bool [E, 1] each, as TorchRL has them.
    flags = {
        name: Binary(n=1, shape=shape_E1, dtype=torch.bool, device=device)
        for name in ("done", "terminated", "truncated")
    }
    leaves = (
        groups,
        {"action": action},
        {"reward": Unbounded(shape=shape_E1, device=device)},
        flags,
    )
    specs = tuple(map(composite, leaves))
    for spec in specs:
        # Labels, so that EnvStates made from specs are labelled, too.
        spec.names = [dims.E]
    observation, action_spec, reward, done = specs
    return observation, action_spec, reward, done


def misfit(value: object, spec: TensorSpec) -> str:
    """Return how a value differs from its spec in type, dtype or shape, or nothing."""
    if not isinstance(value, Tensor):
        given = type(value).__name__
    elif value.dtype != spec.dtype or value.shape != spec.shape:
        given = f"{value.dtype} {tuple(value.shape)}"
    else:
        return ""
    return (
        f"is {given}, and its spec says {spec.dtype} {tuple(spec.shape)}: return what the spec says, or say in "
        "`transform_observation_spec` what the transform makes of it"
    )
