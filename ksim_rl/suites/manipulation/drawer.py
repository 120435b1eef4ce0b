"""A Panda opens a drawer: its gripper moves in task space, closes around the handle and pulls.

Rewards have no stages: a gripper at the handle, fingers on both sides of it, and a drawer that is open each pay by
themselves.
"""

from dataclasses import dataclass

import mujoco
import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl import mdp
from ksim_rl.checked import Checked, Positive
from ksim_rl.data import DatasetCfg
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.envs.term import MetricTerm, ObservationTerm, RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.fields import GaussianReward, OfJoints
from ksim_rl.objectives import PPOCfg
from ksim_rl.physics import SimCfg
from ksim_rl.scene.keyframes import compile_keyframes
from ksim_rl.scene.objects import Drawer
from ksim_rl.scene.robots.edit import drop_bodies
from ksim_rl.scene.scene import Placement, SceneCfg
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.suites.manipulation.bodies import PlaygroundModel
from ksim_rl.trainers import TrainerCfg, TrainingCfg
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg

ARM = "panda/joint[1-7]"
FINGER = "panda/finger_joint1"
"""The driven finger; an equality moves the other one."""
FINGERS = ("panda/left_finger", "panda/right_finger")
GRIPPER = "panda/gripper"
SLIDE = "drawer/slide"
HANDLE = "drawer/handle"
GRIP = "drawer/grip"
OPEN = 0.2
"""m: the drawer counts as open."""


@dataclass(frozen=True, kw_only=True)
class PandaArm(Checked):
    """MuJoCo Playground's Panda on its floor, without the cube; its default pose is the keyframe "home"."""

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model; a ValueError where the package of the models is missing."""
        spec = PlaygroundModel(scene="panda_cube").spec()
        compile_keyframes(spec)
        drop_bodies(spec, ("box", "mocap_target"))
        for key in spec.keys[1:]:
            spec.delete(key)
        return spec


@dataclass(frozen=True, kw_only=True)
class SiteToSite(ObservationTerm):
    """A site minus another one, world frame, m, [E, 3]; position stage."""

    site: str
    start: str

    def __call__(self, view: EnvView) -> Float[Tensor, "E 3"]:
        return view.site(self.site).pos_EL - view.site(self.start).pos_EL


@dataclass(frozen=True, kw_only=True)
class NearSite(GaussianReward):
    """exp(-d^2 / std^2), `d` the distance of two sites, m, [E]; position stage."""

    site: str
    start: str

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        offset_E3 = view.site(self.site).pos_EL - view.site(self.start).pos_EL
        return self.rate(offset_E3.square().sum(-1))


@dataclass(frozen=True, kw_only=True)
class Around(NearSite):
    """`NearSite` where two bodies (`fingers`) are on the two sides of the site along the x axis of `body`, else 0."""

    body: str
    fingers: tuple[str, str]

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        ahead_E3 = view.body(self.body).axes_E33[:, 0]
        away_EN3 = view.bodies(self.fingers).pos_EN3 - view.site(self.site).pos_EL[:, None]
        first_E, second_E = (away_EN3 * ahead_E3[:, None]).sum(-1).unbind(-1)
        return torch.where(first_E * second_E < 0.0, super().__call__(view), 0.0)


@dataclass(frozen=True, kw_only=True)
class Opened(OfJoints, RewardTerm):
    """How far a slide or hinge is open, as a share of `at` (m or rad), in [0, 1], [E]; position stage."""

    at: Positive

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return (view.joints(self.joints).pos_EL.mean(-1) / self.at).clamp(0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class IsOpen(OfJoints, MetricTerm):
    """1 where a slide or hinge is open by at least `at`, m or rad, else 0, [E]; position stage."""

    at: Positive

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return (view.joints(self.joints).pos_EL.mean(-1) >= self.at).to(torch.float32)


def panda_open_drawer() -> ManagerBasedRlEnvCfg:
    """Return the config: 50 Hz control, episodes of 4 s, rewards per second."""
    to_grip = {"site": GRIP, "start": GRIPPER}
    terms: dict[str, ObservationTerm] = {
        "joint_pos": mdp.JointPosRel(joints=(ARM, FINGER)),
        "joint_vel": mdp.JointVel(joints=(ARM, FINGER)),
        "gripper_axes": mdp.BodyRotation6d(bodies="panda/hand", frame="world"),
        "to_grip": SiteToSite(**to_grip),
        "opening": mdp.JointPos(joints=SLIDE),
        "opening_speed": mdp.JointVel(joints=SLIDE),
        "last_action": mdp.LastAction(),
    }
    group = ObservationGroupCfg(
        terms={name: ObservationTermCfg(term=term) for name, term in terms.items()}
    )
    return ManagerBasedRlEnvCfg(
        decimation=4,
        scene=SceneCfg(
            robots={"panda": PandaArm()},
            objects={"drawer": Drawer()},
            # The gripper starts at x = 0.68 and 6 cm above the bar.
            placements={"drawer": Placement(pos=(0.73, 0.0, 0.0))},
            num_envs=2048,
        ),
        sim=SimCfg(njmax=128),
        observations={"actor": group, "critic": group},
        actions={
            # Up to 3 cm in an env step. The null space keeps the gripper about where it points at the start.
            "gripper": mdp.DifferentialIKAction(
                joints=ARM, site=GRIPPER, scale=0.03, clip=(-1.0, 1.0), posture_weight=0.1
            ),
            "fingers": mdp.ActuatorAction(actuators="panda/actuator8", scale=0.02, offset=0.02),
        },
        events={
            "arm": mdp.ResetJoints(joints=ARM, position_range=(-0.05, 0.05)),
            "drawer": mdp.ResetJoints(joints=SLIDE),
        },
        rewards={
            "near": NearSite(**to_grip, std=0.15, weight=1.0),
            "at": NearSite(**to_grip, std=0.03, weight=1.0),
            "around": Around(**to_grip, std=0.03, body=HANDLE, fingers=FINGERS, weight=0.5),
            "opened": Opened(joints=SLIDE, at=OPEN, weight=4.0),
            "action_rate": mdp.ActionRateL2(weight=-0.01),
            "joint_vel": mdp.JointVelL2(joints=ARM, weight=-0.005),
        },
        terminations={"time_out": mdp.TimeOut()},
        metrics={"is_open": IsOpen(joints=SLIDE, at=0.9 * OPEN, reduce="last")},
        episode_length_s=4.0,
        viewer=ViewerCfg(lookat=(0.5, 0.0, 0.3), distance=1.8, elevation=-20.0, azimuth=120.0),
    )


DRAWER = Task(
    name="panda_open_drawer",
    description="a Panda opens a drawer by its handle, with its gripper driven in task space",
    cfg=panda_open_drawer,
    training=TrainingCfg(
        num_envs=2048,
        objective=PPOCfg(entropy_coeff=0.003, clip_value=False),
        data=DatasetCfg(num_env_states_per_minibatch=12288, num_minibatches=4),
        trainer=TrainerCfg(num_iterations=500, eval_interval=50),
    ),
)
