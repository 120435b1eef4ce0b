"""The Panda that picks a cube up by a camera's pictures: where the cube is, nothing else tells it."""

from dataclasses import replace
from functools import partial

from ksim_rl import mdp
from ksim_rl.data import DatasetCfg
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.modules import ActorCfg, CriticCfg, EncoderCfg
from ksim_rl.objectives import PPOCfg
from ksim_rl.scene.sensors import CameraSensor
from ksim_rl.suites.manipulation.panda import COMMAND, panda_pick_cube
from ksim_rl.trainers import ModulesCfg, TrainerCfg, TrainingCfg
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg

CAMERA = "front"
LIGHT = "top"
_OF_THE_ARM = ("joint_pos", "qvel", "gripper_pos", "gripper_axes", "target_error")


def panda_pick_cube_pixels() -> ManagerBasedRlEnvCfg:
    """Return the config of `panda_pick_cube` whose policy reads the arm, the target and a picture, and not the cube.

    The camera stands 1 m in front of the cube's place and looks down on it by 37 degrees, "front" uint8
    [E, 64, 64, 3]; each episode draws its pose (2 cm and 2 degrees) and a light. "critic" has the state.
    """
    cfg = panda_pick_cube()
    # 0.8 m of the table in 64 pixels: 12 mm each, of which the cube has 40.
    camera = CameraSensor(
        pos=(1.45, 0.0, 0.75),
        xyaxes=(0.0, 1.0, 0.0, -0.6, 0.0, 0.8),
        fovy=42.0,
        width=64,
        height=64,
    )
    state = cfg.observations["critic"].terms
    arm = {name: state[name] for name in _OF_THE_ARM}
    goal = ObservationTermCfg(term=mdp.Command(command=COMMAND))
    picture = ObservationTermCfg(term=mdp.CameraImage(sensor=CAMERA))
    few_degrees = dict.fromkeys(("roll", "pitch", "yaw"), (-0.035, 0.035))
    looks = {
        "camera_pos": mdp.RandomizeCameraPos(cameras=CAMERA, ranges=(-0.02, 0.02)),
        "camera_turn": mdp.RandomizeCameraQuat(cameras=CAMERA, ranges=few_degrees),
        "light_pos": mdp.RandomizeLightPos(lights=LIGHT, ranges=(-0.5, 0.5)),
        "light_color": mdp.RandomizeLightColor(lights=LIGHT, ranges=(0.6, 1.2), operation="scale"),
    }
    return replace(
        cfg,
        scene=replace(cfg.scene, sensors={**cfg.scene.sensors, CAMERA: camera}),
        observations={
            "actor": ObservationGroupCfg(terms={**arm, "target": goal}),
            "critic": cfg.observations["critic"],
            CAMERA: ObservationGroupCfg(terms={"rgb": picture}),
        },
        events={**(cfg.events or {}), **looks},
    )


_squashed = partial(ActorCfg, distribution="tanh_gaussian", state_dependent_std=True, init_std=0.7)

PANDA_PIXELS = Task(
    name="panda_pick_cube_pixels",
    suite="manipulation",
    description="a Panda picks a cube up that only the pictures of a camera show",
    cfg=panda_pick_cube_pixels,
    training=TrainingCfg(
        num_envs=1024,
        objective=PPOCfg(
            gamma=0.97,
            num_epochs=4,
            learning_rate=5e-4,
            schedule="fixed",
            entropy_coeff=0.03,
            clip_epsilon=0.3,
            clip_value=False,
            critic_coeff=0.25,
        ),
        data=DatasetCfg(num_env_states_per_minibatch=2560, num_minibatches=16),
        modules=ModulesCfg(
            actor=_squashed(
                in_keys=("actor", CAMERA),
                encoders={CAMERA: EncoderCfg(spatial_softmax=True)},
                hidden_dims=(256, 128),
                activation="silu",
            ),
            critic=CriticCfg(hidden_dims=(256, 256), activation="silu"),
        ),
        trainer=TrainerCfg(num_iterations=600, eval_interval=100),
    ),
)
