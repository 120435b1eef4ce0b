"""Tasks whose policy sees pictures alone."""

from dataclasses import replace

from ksim_rl import mdp
from ksim_rl.data import DatasetCfg
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.modules import FEATURES, ActorCfg, CriticCfg, EncoderCfg, SharedTrunkCfg
from ksim_rl.objectives import PPOCfg
from ksim_rl.scene.sensors import CameraSensor
from ksim_rl.tasks.control_suite import cartpole_balance
from ksim_rl.trainers import ModulesCfg, TrainerCfg, TrainingCfg
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg
from ksim_rl.transforms.history import HistoryCfg


def cartpole_balance_pixels() -> ManagerBasedRlEnvCfg:
    """Return the config of `cartpole_balance` seen by a camera beside the rail.

    "actor" has the last three pictures, uint8 [E, 3, 64, 64, 3], in which speeds can be seen; "critic" has the state,
    which nothing reads unless `modules.critic.in_keys` says so.
    """
    cfg = cartpole_balance()
    # 2.5 m of the rail are seen, from 3 m away.
    camera = CameraSensor(
        pos=(0.0, -3.0, 1.0), xyaxes=(1.0, 0.0, 0.0, 0.0, 0.0, 1.0), width=64, height=64
    )
    frames = ObservationGroupCfg(
        terms={"rgb": ObservationTermCfg(term=mdp.CameraImage(sensor="side"))},
        history=HistoryCfg(length=3, flat=False),
    )
    return replace(
        cfg,
        scene=replace(cfg.scene, sensors={"side": camera}),
        observations={**cfg.observations, "actor": frames},
    )


CARTPOLE_BALANCE_PIXELS = Task(
    name="cartpole_balance_pixels",
    description="keep a pole upright on a cart, by pictures of 64 x 64 pixels alone",
    cfg=cartpole_balance_pixels,
    training=TrainingCfg(
        num_envs=512,
        # Values reach 100 here: clipping their change to 0.2 would stop the critic from learning.
        objective=PPOCfg(
            clip_value=False,
            schedule="fixed",
            learning_rate=5e-4,
            num_epochs=4,
            entropy_coeff=0.0,
        ),
        data=DatasetCfg(num_env_states_per_minibatch=2048, num_minibatches=8),
        # One encoder for actor and critic, as encoding is most of the work.
        modules=ModulesCfg(
            trunk=SharedTrunkCfg(encoders={"actor": EncoderCfg()}, hidden_dims=(256,)),
            actor=ActorCfg(in_keys=(FEATURES,), hidden_dims=(64,), obs_normalization=False),
            critic=CriticCfg(in_keys=(FEATURES,), hidden_dims=(64,), obs_normalization=False),
        ),
        trainer=TrainerCfg(num_iterations=120, eval_interval=10),
    ),
    solved_at=900.0,
)
