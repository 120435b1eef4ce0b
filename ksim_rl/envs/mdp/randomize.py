"""Events that make each world's model differ: domain randomization."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from ksim_rl.checks import check_choice, check_in_range, check_pair
from ksim_rl.envs.mdp.constants import constant
from ksim_rl.envs.names import Patterns
from ksim_rl.envs.term import EventTerm
from ksim_rl.envs.view import EnvView

Mode = Literal["startup", "reset", "interval", "step"]


@dataclass(frozen=True, kw_only=True)
class RandomizeModelField(EventTerm):
    """Draw entries of a model field per world. Subclasses name the field; its rows are elements of one kind.

    Attributes:
        elements: names or patterns of what is randomized.
        ranges: by column of the field, what to draw from.
        operation: "abs" replaces the entry, "add" and "scale" start from the model's own value, not from the last draw.
        distribution: over the range, in the same unit; "log_uniform" needs positive bounds.
        shared: one draw per column for all elements of a world, instead of one for each.
    """

    elements: Patterns
    ranges: Mapping[int, tuple[float, float]]
    operation: Literal["abs", "add", "scale"] = "abs"
    distribution: Literal["uniform", "log_uniform"] = "uniform"
    shared: bool = False
    mode: Mode = "startup"

    field: ClassVar[str]
    kind: ClassVar[str]
    columns: ClassVar[int]

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("operation", self.operation, ("abs", "add", "scale"))
        check_choice("distribution", self.distribution, ("uniform", "log_uniform"))
        for column, pair in self.ranges.items():
            check_choice("ranges", column, range(self.columns))
            check_pair(f"ranges[{column}]", pair)
            if self.distribution == "log_uniform":
                check_in_range(f"ranges[{column}][0] (log_uniform)", pair[0], low=0.0, low_open=True)

    @property
    def per_world_fields(self) -> tuple[str, ...]:
        """The one field that this event writes."""
        return (self.field,)

    def __call__(self, view: EnvView, mask_E: Tensor) -> None:
        """Draw for the rows of `mask_E`."""
        index = view.resolver.index(self.kind, self.elements)
        ids = view.resolver.ids(self.kind, self.elements)
        nominal = getattr(view.world.mj_model, self.field)
        for column, (low, high) in sorted(self.ranges.items()):
            drawn_EN = self._draw(view, 1 if self.shared else len(ids), float(low), float(high))
            own_N = constant(tuple(float(nominal[i, column]) for i in ids), view.device)
            if self.operation == "add":
                drawn_EN = own_N + drawn_EN
            elif self.operation == "scale":
                drawn_EN = own_N * drawn_EN
            entries_EN = view.field(self.field)[..., column]
            entries_EN[:, index] = torch.where(mask_E[:, None], drawn_EN, entries_EN[:, index])

    def _draw(self, view: EnvView, count: int, low: float, high: float) -> Tensor:
        if self.distribution == "log_uniform":
            return torch.exp(view.uniform(count, math.log(low), math.log(high)))
        return view.uniform(count, low, high)


@dataclass(frozen=True, kw_only=True)
class RandomizeGeomFriction(RandomizeModelField):
    """Friction of geoms; columns: 0 sliding, 1 torsional (m), 2 rolling (m)."""

    field: ClassVar[str] = "geom_friction"
    kind: ClassVar[str] = "geom"
    columns: ClassVar[int] = 3


@dataclass(frozen=True, kw_only=True)
class RandomizeBodyCom(RandomizeModelField):
    """Centre of mass of bodies in the body's frame, m; columns x, y, z."""

    field: ClassVar[str] = "body_ipos"
    kind: ClassVar[str] = "body"
    columns: ClassVar[int] = 3


@dataclass(frozen=True, kw_only=True)
class RandomizeEncoderBias(EventTerm):
    """Offset between a joint's position and what its encoder reads, uniform, per joint and world.

    Observations show it where they ask for it (`JointPosRel(biased=True)`); nothing else feels it.

    Attributes:
        bias_range: rad or m.
        joints: names or patterns.
    """

    bias_range: tuple[float, float]
    joints: Patterns = ".*"
    mode: Mode = "startup"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_pair("bias_range", self.bias_range)

    def __call__(self, view: EnvView, mask_E: Tensor) -> None:
        """Draw for the rows of `mask_E`."""
        index = view.joints(self.joints)
        held_EL = view.encoder_bias_EL[:, index]
        low, high = self.bias_range
        drawn_EL = view.uniform(held_EL.shape[1], float(low), float(high))
        view.encoder_bias_EL[:, index] = torch.where(mask_E[:, None], drawn_EL, held_EL)
