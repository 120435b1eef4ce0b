"""These rewards rate how a robot holds itself: its tilt, its height, its joints."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import Positive
from ksim_rl.checks import check_in_range
from ksim_rl.envs.term import RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.commands.speed import commanded_speed
from ksim_rl.mdp.constants import constant, values_by_name
from ksim_rl.mdp.fields import OfEntity, OfJoints
from ksim_rl.mdp.quantities import root_height
from ksim_rl.mdp.rewards.gaussian_reward import GaussianReward


@dataclass(frozen=True, kw_only=True)
class OfTilt(OfEntity):
    """A reward of the tilt of a body.

    Attributes:
        body: its name; None is the root of `entity`.
    """

    body: str | None = None

    def tilt(self, view: EnvView) -> Float[Tensor, " E"]:
        """Return |g_xy|^2, `g` the direction of gravity in the body's frame: the squared sine of the tilt."""
        if self.body is None:
            return view.entity(self.entity).projected_gravity_EL[:, :2].square().sum(-1)
        # The world's z axis in the body's frame: the z components of the body's x and y axes.
        return view.body(self.body).axes_E33[:, :2, 2].square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class Upright(OfTilt, GaussianReward):
    """exp(-|g_xy|^2 / std^2), `g` the direction of gravity in the body's frame; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return self.rate(self.tilt(view))


@dataclass(frozen=True, kw_only=True)
class TiltL2(OfTilt, RewardTerm):
    """|g_xy|^2, `g` the direction of gravity in the body's frame, the squared sine of the tilt; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return self.tilt(view)


@dataclass(frozen=True, kw_only=True)
class RootHeightL2(OfEntity, RewardTerm):
    """(h - target_height)^2, `h` the height of the root body's frame above the ground, m^2, [E]; position stage.

    Attributes:
        target_height: m.
    """

    target_height: float

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return (root_height(view, self.entity) - self.target_height).square()


@dataclass(frozen=True, kw_only=True)
class Pose(OfJoints, RewardTerm):
    """exp(-mean_j((q_j - q0_j)^2 / std_j^2)) about the default pose, [E]; position stage.

    How far a joint may stray depends on the commanded speed s = |c_xy| + |c_z|: standing below `walking_threshold`,
    running from `running_threshold` on, walking between.

    Attributes:
        std_standing, std_walking, std_running: rad or m by joint; keys are regular expressions, and together they
            match each of `joints` once.
    """

    command: str
    std_standing: Mapping[str, Positive]
    std_walking: Mapping[str, Positive]
    std_running: Mapping[str, Positive]
    walking_threshold: float
    running_threshold: float

    def __post_init__(self) -> None:
        super().__post_init__()
        check_in_range("running_threshold", self.running_threshold, low=self.walking_threshold)

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        speed_E1 = commanded_speed(view, self.command).unsqueeze(-1)
        std_EL = torch.where(
            speed_E1 < self.walking_threshold,
            self._std(view, "std_standing"),
            torch.where(
                speed_E1 < self.running_threshold,
                self._std(view, "std_walking"),
                self._std(view, "std_running"),
            ),
        )
        error_EL = view.joints(self.joints).pos_rel_EL
        return torch.exp(-(error_EL / std_EL).square().mean(-1))

    def _std(self, view: EnvView, field: str) -> Tensor:
        names = view.joints(self.joints).names
        return constant(values_by_name(field, getattr(self, field), names), view.device)
