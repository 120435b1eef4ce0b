"""Go1 on stairs, slopes and rough ground, which it sees by a depth camera instead of knowing the heights around it."""

import dataclasses

from ksim_rl import mdp
from ksim_rl.data import DatasetCfg
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.modules import ActorCfg, CriticCfg, EncoderCfg, RecurrentCfg
from ksim_rl.objectives import PPOCfg
from ksim_rl.scene.sensors import CameraSensor
from ksim_rl.tasks.velocity_flat import GO1_ROBOT, ROUGH, go1_velocity_rough
from ksim_rl.trainers import ModulesCfg, TrainerCfg, TrainingCfg
from ksim_rl.transforms import (
    DelayCfg,
    DepthHoles,
    DepthRange,
    ObservationDelay,
    ObservationHold,
    PictureEffects,
)
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg
from ksim_rl.transforms.transform_cfg import TransformCfg

CAMERA = "depth"
FRESH = ("camera", "fresh")
STUDENT = "student"
# In front of the trunk, 30 degrees down: right and up of the picture, in the frame of the trunk.
_AHEAD = (0.3, 0.0, 0.03)
_DOWN = (0.0, -1.0, 0.0, 0.5, 0.0, 0.866)
MAX_DEPTH = 3.0
"""m; what is farther is read as this."""


def go1_depth_rough() -> ManagerBasedRlEnvCfg:
    """Return the config of `go1_velocity_rough` with what a student may read instead of the heights.

    "student" has the actor's terms without the height scan, and "depth" the distances that a camera sees, m, float32
    [E, 48, 64], with the faults of a real one: a picture every third step of 20 ms, of which one in ten is lost, so
    that 15 arrive per second; 3 to 9 steps late, which are 1 to 3 pictures; holes, and nothing nearer than 0.15 m.
    ("camera", "fresh") is 1 where the picture is new. "actor" keeps the heights, for the teacher.
    """
    cfg = go1_velocity_rough()
    camera = CameraSensor(
        body=GO1_ROBOT.root_body,
        pos=_AHEAD,
        xyaxes=_DOWN,
        fovy=58.0,
        width=64,
        height=48,
        rgb=False,
        depth=True,
        max_depth=MAX_DEPTH,
    )
    seen = ObservationTermCfg(term=mdp.CameraImage(sensor=CAMERA, output="depth"))
    actor = cfg.observations["actor"]
    known = {name: term for name, term in actor.terms.items() if name != "height_scan"}
    faults = {"range": DepthRange(reach=(0.15, MAX_DEPTH)), "holes": DepthHoles(share=0.05)}
    return dataclasses.replace(
        cfg,
        scene=dataclasses.replace(cfg.scene, sensors={**cfg.scene.sensors, CAMERA: camera}),
        observations={
            **cfg.observations,
            STUDENT: dataclasses.replace(actor, terms=known),
            CAMERA: ObservationGroupCfg(terms={"distance": seen}),
        },
        transforms={
            **cfg.transforms,
            "faults": TransformCfg(PictureEffects, in_keys=[CAMERA], effects=faults),
            "rate": TransformCfg(
                ObservationHold, in_keys=[CAMERA], every=3, dropped=0.1, fresh_key=FRESH
            ),
            # The flag is as late as its picture.
            "lag": TransformCfg(
                ObservationDelay,
                in_keys=[CAMERA, FRESH],
                delay=DelayCfg(min_lag=3, max_lag=9),
            ),
        },
    )


GO1_DEPTH_ROUGH = Task(
    name="go1_depth_rough",
    description=f"Unitree Go1 follows a velocity command {ROUGH} that a depth camera sees",
    cfg=go1_depth_rough,
    # For `objective=distillation objective.teacher=RUN`, which takes data and networks over; PPO alone learns as well.
    training=TrainingCfg(
        num_envs=1024,
        seed=42,
        objective=PPOCfg(gamma=0.98, entropy_coeff=0.01),
        data=DatasetCfg(num_env_states_per_minibatch=6144, num_minibatches=4),
        modules=ModulesCfg(
            actor=ActorCfg(
                in_keys=(STUDENT, FRESH, CAMERA),
                # Three convolutions see 3 m as 1.
                encoders={CAMERA: EncoderCfg(value_range=(0.0, MAX_DEPTH))},
                hidden_dims=(256, 128),
                output_gain=1.0,
            ),
            critic=CriticCfg(),
            # What the camera saw is under the feet a second later.
            recurrent_actor=RecurrentCfg(kind="gru", hidden_dim=256),
        ),
        trainer=TrainerCfg(num_iterations=3_000),
    ),
)
