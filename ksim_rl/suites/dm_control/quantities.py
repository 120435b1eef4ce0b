"""These terms are the observations and rewards of the DeepMind Control Suite; its rewards are products of tolerances.

Directions are named as in dm_control: the axes "xz" of a matrix are the x component of a body's z axis.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ksim_rl.checked import Checked, NonNegative, Share
from ksim_rl.envs.term import ObservationTerm, RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import index_constant
from ksim_rl.mdp.rewards.tracking import tolerance
from ksim_rl.scene.names import Patterns

AXES = "xyz"
POINTS = ("body", "com", "geom", "site", "command")


@dataclass(frozen=True, kw_only=True)
class GeneralizedVelocity(ObservationTerm):
    """All of MuJoCo's qvel, [E, nv]: a free root has m/s in the world frame, then rad/s in its own; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        # A copy: the state changes in place.
        return view.world.qvel_EL.clone()


@dataclass(frozen=True, kw_only=True)
class Control(ObservationTerm):
    """The controls of all actuators, [E, nu], in the units of their control ranges; 0 after a reset."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.world.ctrl_EL.clone()


@dataclass(frozen=True, kw_only=True)
class Readings(ObservationTerm):
    """Readings of MJCF sensors, [E, L]: whole ones, "tip", or components of vectors, "tip.xz"; `log` takes log(1 + x).

    Touch sensors, N, belong to the last physics substep.
    """

    sensors: tuple[str, ...]
    log: bool = False

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        parts = []
        for entry in self.sensors:
            # "name.xz" picks components, "name" takes all.
            name, _, axes = entry.partition(".")
            reading_EL = view.sensor(name)
            parts.append(reading_EL[:, _columns(view, axes)] if axes else reading_EL)
        readings_EL = torch.cat(parts, dim=-1)
        if self.log:
            return torch.log1p(readings_EL)
        return readings_EL


@dataclass(frozen=True, kw_only=True)
class BodyAxes(ObservationTerm):
    """Entries of the orientation matrices of bodies, such as ("xz", "zz"), [E, N * entries]; position stage.

    All entries of a body stand together, or with `by_entry` all bodies of an entry.
    """

    bodies: Patterns
    entries: tuple[str, ...]
    by_entry: bool = False

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        # Row b of `axes_EN33` is the axis b of the body, whose components are along the world's axes.
        axes_EN33 = view.bodies(self.bodies).axes_EN33
        # Names are (component, axis), as in dm_control's matrices.
        values = [
            axes_EN33[..., AXES.index(axis), AXES.index(component)]
            for component, axis in self.entries
        ]
        return torch.stack(values, dim=1 if self.by_entry else -1).flatten(start_dim=1)


@dataclass(frozen=True, kw_only=True)
class Offset(ObservationTerm):
    """Points minus another, m, [E, points * axes], in the axes of a geom or body, or of the world; position stage.

    A point is "body:torso", "com:torso" (centre of mass), "geom:nose", "site:tip" or "command:target"; the `start` ""
    is the world's origin.
    """

    ends: tuple[str, ...]
    start: str = ""
    frame: str = ""
    axes: str = AXES

    def _check_fields(self) -> None:
        super()._check_fields()
        for point in (*self.ends, *filter(None, (self.start, self.frame))):
            # Names are looked up later, kinds can be refused now.
            if point.partition(":")[0] not in POINTS:
                raise ValueError(
                    f"ends, start or frame {point!r}: expected a point such as 'body:torso'; kinds are {POINTS}"
                )

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        # [E, N, 3] in the world frame.
        offset_EN3 = torch.stack([_point(view, end) for end in self.ends], dim=1)
        if self.start:
            offset_EN3 = offset_EN3 - _point(view, self.start)[:, None]
        if self.frame:
            # Columns of the frame's matrix are its axes: components along these.
            offset_EN3 = torch.einsum("enw,ewf->enf", offset_EN3, _axes(view, self.frame))
        return offset_EN3[..., _columns(view, self.axes)].flatten(start_dim=1)


@dataclass(frozen=True, kw_only=True)
class Distance(ObservationTerm):
    """The length of a vector minus a radius, in the vector's unit, [E, 1]."""

    of: ObservationTerm
    radius: NonNegative = 0.0

    def __call__(self, view: EnvView) -> Float[Tensor, "E 1"]:
        # Inside of the radius it is negative.
        return torch.linalg.vector_norm(self.of(view), dim=-1, keepdim=True) - self.radius


def _point(view: EnvView, point: str) -> Float[Tensor, "E 3"]:
    """Return a point's position, world frame, m."""
    kind, _, name = point.partition(":")
    # Commands are points in the world frame.
    if kind == "command":
        return view.command(name)
    if kind == "site":
        return view.site(name).pos_EL
    if kind == "body":
        return view.body(name).pos_EL
    world = view.derived()
    # The body's own centre of mass, without its children.
    if kind == "com":
        return world.xipos_EL[:, view.resolver.one("body", name)]
    return world.geom_xpos_EL[:, view.resolver.one("geom", name)]


def _axes(view: EnvView, frame: str) -> Float[Tensor, "E 3 3"]:
    """Return the matrix of a body's or geom's orientation: its columns are its axes in the world."""
    kind, _, name = frame.partition(":")
    if kind == "geom":
        # MuJoCo's matrices have the axes as columns already.
        return view.derived().geom_xmat_EL[:, view.resolver.one("geom", name)]
    return view.body(name).axes_E33.transpose(-1, -2)


def _columns(view: EnvView, axes: str) -> Int[Tensor, " N"] | slice:
    return index_constant([AXES.index(axis) for axis in axes], view.device)


@dataclass(frozen=True, kw_only=True)
class Factor(Checked):
    """How well a quantity lies in [low, high], in [floor, 1]: `tolerance`, the mean over the quantity's elements.

    Its fields are as in `tolerance`, where None is no bound; the factor is floor + (1 - floor) * tolerance.
    """

    of: ObservationTerm
    low: float | None = None
    high: float | None = None
    margin: NonNegative = 0.0
    value_at_margin: Share = 0.1
    shape: Literal["gaussian", "linear", "quadratic", "long_tail"] = "gaussian"
    floor: Share = 0.0

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        """Return the factor of the current state, float32 [E]."""
        rated_EL = tolerance(
            self.of(view),
            # None cannot stand in a comparison of tensors.
            low=-math.inf if self.low is None else self.low,
            high=math.inf if self.high is None else self.high,
            margin=self.margin,
            value_at_margin=self.value_at_margin,
            shape=self.shape,
        )
        # The floor keeps a product from falling to 0 by this factor alone.
        return self.floor + (1.0 - self.floor) * rated_EL.mean(-1)


@dataclass(frozen=True, kw_only=True)
class ToleranceProduct(RewardTerm):
    """The product of some factors, each in [0, 1], [E] (Tassa et al., "DeepMind Control Suite", 2018, section 4)."""

    factors: Mapping[str, Factor]

    def _check_fields(self) -> None:
        super()._check_fields()
        if not self.factors:
            raise ValueError("factors={}: name at least one factor")

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return torch.stack([factor(view) for factor in self.factors.values()]).prod(dim=0)
