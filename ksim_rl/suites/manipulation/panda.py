"""A Panda picks a cube up and carries it to a place in the air, with MuJoCo Playground's rewards (PandaPickCube).

Its file `pick.py` is the source of all formulas.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl import mdp
from ksim_rl.checked import Positive
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.term import ObservationTerm, RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant
from ksim_rl.physics import SimCfg
from ksim_rl.scene.scene import SceneCfg
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.suites.dm_control.quantities import (
    BodyAxes,
    Factor,
    GeneralizedVelocity,
    Offset,
    Readings,
    ToleranceProduct,
)
from ksim_rl.suites.dm_control.targets import BoxTarget
from ksim_rl.suites.manipulation.bodies import LeavesBox, PlaceFreeBody, PlaygroundModel
from ksim_rl.suites.manipulation.targets import JointTarget, MoveTargets
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg

COMMAND = "target"
BOX = "box"
GRIPPER = "gripper"
ARM = "joint[1-7]"
DRIVEN = (ARM, "finger_joint1")  # an equality moves the other finger
# Of an orientation's matrix: entry "yx" is the y component of the x axis.
_LAST_ROWS = ("yx", "yy", "yz", "zx", "zy", "zz")
_FIRST_ROWS = ("xx", "xy", "xz", "yx", "yy", "yz")
_UPRIGHT = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class TurnFromUpright(ObservationTerm):
    """The first two rows of the unit matrix minus a body's orientation matrix, [E, 6]; position stage."""

    body: str

    def __call__(self, view: EnvView) -> Float[Tensor, "E 6"]:
        rows_E6 = BodyAxes(bodies=self.body, entries=_FIRST_ROWS)(view)
        return constant(_UPRIGHT, view.device) - rows_E6


@dataclass(frozen=True, kw_only=True)
class OneMinusTanh(RewardTerm):
    """1 - tanh(gain |v|) of a vector v such as an offset, in [0, 1], [E]; `gain` per unit of v."""

    of: ObservationTerm
    gain: Positive = 1.0

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        # 1 at the target, with a slope everywhere.
        length_E = torch.linalg.vector_norm(self.of(view), dim=-1)
        return 1.0 - torch.tanh(self.gain * length_E)


@dataclass(frozen=True, kw_only=True)
class CarryToTarget(RewardTerm):
    """1 - tanh(5 (0.9 d + 0.1 r)) once a site has been at a body in the episode, before that 0, [E]; position stage.

    d (m) is the distance of the body from a commanded place, r the length of `TurnFromUpright`; the site was at the
    body when it was within `reach` (m) of its origin.
    """

    command: str
    body: str
    site: str
    reach: Positive = 0.012

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        body_E3 = view.body(self.body).pos_EL
        gap_E3 = body_E3 - view.site(self.site).pos_EL
        gap_E = torch.linalg.vector_norm(gap_E3, dim=-1)
        was_there_E = view.buffer("was_there_E", dtype=torch.bool)
        # It stays true for the rest of the episode; resets clear it.
        was_there_E.logical_or_(gap_E < self.reach)
        target_E3 = view.command(self.command)[:, :3]
        distance_E = torch.linalg.vector_norm(target_E3 - body_E3, dim=-1)
        turn_E3 = TurnFromUpright(body=self.body)(view)
        turn_E = torch.linalg.vector_norm(turn_E3, dim=-1)
        # 5 * 0.9 and 5 * 0.1.
        return (1.0 - torch.tanh(4.5 * distance_E + 0.5 * turn_E)) * was_there_E


def panda_pick_cube() -> ManagerBasedRlEnvCfg:
    """Return the config: 50 Hz control, episodes of 150 steps, rewards per step."""
    to_gripper = Offset(ends=(f"body:{BOX}",), start=f"site:{GRIPPER}")
    readings: dict[str, ObservationTerm] = {
        "joint_pos": mdp.JointPos(),
        "box_pos": Offset(ends=(f"body:{BOX}",)),
        "box_quat": mdp.BodyQuat(bodies=BOX, frame="world"),
        "qvel": GeneralizedVelocity(),
        "gripper_pos": Offset(ends=(f"site:{GRIPPER}",)),
        # The site has the axes of its body.
        "gripper_axes": BodyAxes(bodies="hand", entries=_LAST_ROWS),
        "box_axes": BodyAxes(bodies=BOX, entries=_LAST_ROWS),
        "gripper_to_box": to_gripper,
        "box_to_target": Offset(ends=(f"command:{COMMAND}",), start=f"body:{BOX}"),
        "box_turn": TurnFromUpright(body=BOX),
        "target_error": JointTarget(joints=DRIVEN, relative=True),
    }
    group = ObservationGroupCfg(
        # Actor and critic see the same.
        terms={name: ObservationTermCfg(term=term) for name, term in readings.items()}
    )
    # 1 while the sensor finds no contact with the floor.
    off_floor = {
        geom: Factor(of=Readings(sensors=(f"{geom}_floor_found",)), high=0.0)
        for geom in ("left_finger_pad", "right_finger_pad", "hand_capsule")
    }
    return ManagerBasedRlEnvCfg(
        decimation=4,
        scene=SceneCfg(robots={"panda": PlaygroundModel(scene="panda_cube")}, num_envs=2048),
        sim=SimCfg(njmax=128),
        observations={"actor": group, "critic": group},
        # Targets move by at most 4 cm or 0.04 rad per unit action and step.
        actions={"joints": MoveTargets(joints=DRIVEN, scale=0.04)},
        events={
            "arm": mdp.ResetJoints(),
            "box": PlaceFreeBody(body=BOX, offset={"x": (-0.2, 0.2), "y": (-0.2, 0.2)}),
        },
        # 0.2 m to each side of the box's default place, and 0.2 to 0.4 m above it.
        commands={COMMAND: BoxTarget(low=(0.5, -0.2, 0.23), high=(0.9, 0.2, 0.43), size=0.02)},
        rewards={
            "gripper_box": OneMinusTanh(of=to_gripper, gain=5.0, weight=4.0),
            "box_target": CarryToTarget(command=COMMAND, body=BOX, site=GRIPPER, weight=8.0),
            "no_floor_collision": ToleranceProduct(factors=off_floor, weight=0.25),
            "arm_pose": OneMinusTanh(of=mdp.JointPosRel(joints=ARM), weight=0.3),
        },
        terminations={
            "time_out": mdp.TimeOut(),
            "lost": LeavesBox(
                body=BOX, low={"x": -1.0, "y": -1.0, "z": 0.0}, high={"x": 1.0, "y": 1.0, "z": 1.0}
            ),
        },
        # Playground's task has no measure of success; 5 cm is taken from its PandaPickCubeCartesian.
        metrics={
            "at_target": mdp.TargetReached(
                command=COMMAND, body=BOX, frame="world", tolerance=0.05, reduce="last"
            )
        },
        episode_length_s=3.0,
        scale_rewards_by_dt=False,
        viewer=ViewerCfg(lookat=(0.4, 0.0, 0.3), distance=1.8, elevation=-25.0, azimuth=140.0),
    )
