"""Our own humanoid follows a velocity command on flat ground; nothing to download."""

from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.scene.robots.own_robots import Humanoid
from ksim_rl.scene.sensors import ContactSensor
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.tasks import velocity

ROBOT = Humanoid()
POSE = velocity.PoseStd(
    standing={".*": 0.05},
    walking={
        ".*_hip_pitch": 0.3,
        ".*_hip_(roll|yaw)": 0.15,
        ".*_knee": 0.35,
        ".*_ankle_pitch": 0.25,
        ".*_ankle_roll": 0.1,
        "waist_yaw": 0.2,
        ".*_shoulder_(pitch|roll)|.*_elbow": 0.15,
    },
    running={
        ".*_hip_pitch": 0.5,
        ".*_hip_(roll|yaw)": 0.2,
        ".*_knee": 0.6,
        ".*_ankle_pitch": 0.35,
        ".*_ankle_roll": 0.15,
        "waist_yaw": 0.3,
        ".*_shoulder_(pitch|roll)|.*_elbow": 0.4,
    },
)


def humanoid_velocity_flat() -> ManagerBasedRlEnvCfg:
    """Return the config."""
    return velocity.velocity_cfg(
        ROBOT,
        sim=velocity.sim(),
        feet=ContactSensor(bodies=ROBOT.foot_bodies),
        sensors=velocity.self_contact(ROBOT),
        observations=velocity.observations(ROBOT),
        rewards=velocity.rewards(
            ROBOT,
            pose=POSE,
            torso=ROBOT.torso_body,
            body_ang_vel=-0.05,
            angular_momentum=-0.02,
            foot_height=0.06,
        )
        | velocity.self_collisions(),
        events=velocity.events(ROBOT, torso=ROBOT.torso_body)
        | {"foot_friction": velocity.foot_friction(ROBOT, low=0.3, high=1.2)},
        viewer=ViewerCfg(body=ROBOT.root_body, distance=2.2, elevation=-12.0, azimuth=130.0),
    )


TASK = Task(
    name="humanoid_velocity_flat",
    description="our humanoid follows a velocity command on flat ground",
    cfg=humanoid_velocity_flat,
    training=velocity.training(num_iterations=3_000),
)
