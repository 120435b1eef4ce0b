"""A planar biped follows a walk: motion imitation after Peng et al., "DeepMimic" (2018).

Episodes start anywhere in the motion, in its state there, and end when the robot strays from it. The reward's parts are
theirs; the robot's own root stands in for the centre of mass.
"""

from ksim_rl import mdp
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.scene.robots.control_models import WALKER_SERVOS, Walker
from ksim_rl.scene.scene import SceneCfg
from ksim_rl.scene.terrains import PlaneTerrain
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.tasks import planar
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg

MOTION = "walker_walk"
CYCLE_S = 1.0
FEET = ("right_foot", "left_foot")


def walker_track() -> ManagerBasedRlEnvCfg:
    """Return the config of walking as the motion `walker_walk` does."""
    terms = {
        "gravity": ObservationTermCfg(term=mdp.ProjectedGravity()),
        "joint_pos": ObservationTermCfg(term=mdp.JointPos(joints=("root_z", Walker.joints))),
        "joint_vel": ObservationTermCfg(term=mdp.JointVel()),
        "phase": ObservationTermCfg(term=mdp.MotionPhase(file=MOTION, cycle_s=CYCLE_S)),
        "reference": ObservationTermCfg(term=mdp.MotionJoints(file=MOTION, joints=Walker.joints)),
        "drift": ObservationTermCfg(term=mdp.MotionBodyOffset(file=MOTION, bodies="torso")),
    }
    return ManagerBasedRlEnvCfg(
        decimation=4,
        scene=SceneCfg(
            robots={"walker": Walker(actuators=WALKER_SERVOS)}, terrain=PlaneTerrain(), num_envs=2048
        ),
        sim=planar.SIM,
        observations={"actor": ObservationGroupCfg(terms=terms), "critic": ObservationGroupCfg(terms=terms)},
        actions={"legs": mdp.JointPositionAction(joints=Walker.joints, scale=0.5)},
        events={"reset": mdp.ResetToMotion(file=MOTION, start_range=(0.0, 0.9))},
        rewards={
            "joint_pos": mdp.TrackMotionJointPos(file=MOTION, joints=Walker.joints, std=0.7, weight=0.65),
            "joint_vel": mdp.TrackMotionJointVel(file=MOTION, joints=Walker.joints, std=3.2, weight=0.1),
            "feet": mdp.TrackMotionBodyPos(file=MOTION, bodies=FEET, std=0.16, weight=0.15),
            "root": mdp.TrackMotionBodyPos(file=MOTION, bodies="torso", std=0.32, weight=0.05),
            "root_rotation": mdp.TrackMotionBodyQuat(file=MOTION, bodies="torso", std=0.32, weight=0.05),
            "action_rate": mdp.ActionRateL2(weight=-0.001),
        },
        terminations={
            "finished": mdp.MotionFinished(file=MOTION),
            "strayed": mdp.FarFromMotion(file=MOTION, bodies="torso", distance=0.4),
        },
        episode_length_s=8.0,
        viewer=ViewerCfg(body="torso", distance=4.0, elevation=-10.0, azimuth=90.0),
    )


TRACK = Task(
    name="walker_track",
    description="a planar biped follows a walk",
    cfg=walker_track,
    training=planar.training(num_iterations=400),
)
