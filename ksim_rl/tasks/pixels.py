"""Tasks whose policy sees pictures alone."""

from dataclasses import dataclass, replace
from typing import Any

import mujoco
import torch
from jaxtyping import Bool
from torch import Tensor

from ksim_rl import mdp
from ksim_rl.algorithms import fast_sac
from ksim_rl.algorithms.fast_sac import FastSACCfg
from ksim_rl.data import DatasetCfg, ReplayCfg
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.envs.view import EnvView
from ksim_rl.modules import FEATURES, ActorCfg, CriticCfg, EncoderCfg, SharedTrunkCfg
from ksim_rl.objectives import PPOCfg
from ksim_rl.scene.robots.control_models import Reacher
from ksim_rl.scene.sensors import CameraSensor
from ksim_rl.tasks.control_suite import (
    TARGET_RADIUS,
    ReacherTarget,
    cartpole_balance,
    cartpole_swingup,
    reacher,
)
from ksim_rl.trainers import ModulesCfg, TrainerCfg, TrainingCfg
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg
from ksim_rl.transforms.history import HistoryCfg

CAMERA = "side"
# Right and up of a picture, in the frame of the world.
FROM_THE_SIDE = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
FROM_ABOVE = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


def _seen(
    cfg: ManagerBasedRlEnvCfg, camera: CameraSensor, *, steps_between_frames: int
) -> ManagerBasedRlEnvCfg:
    """Return a task whose "actor" has three pictures, uint8 [E, 3, H, W, 3], and nothing else.

    The newest is of now, and the others of one and two times `steps_between_frames` env steps ago.
    """
    frames = ObservationGroupCfg(
        terms={"rgb": ObservationTermCfg(term=mdp.CameraImage(sensor=CAMERA))},
        # Speeds can be seen in three pictures, and not in one; and only if things move by some of a pixel in between.
        history=HistoryCfg(length=3, stride=steps_between_frames, flat=False),
    )
    return replace(
        cfg,
        scene=replace(cfg.scene, sensors={CAMERA: camera}),
        observations={**cfg.observations, "actor": frames},
    )


def _training(
    *,
    num_envs: int,
    data: DatasetCfg,
    num_iterations: int,
    eval_interval: int,
    init_std: float = 1.0,
    **objective: Any,
) -> TrainingCfg:
    """Return PPO with one encoder for actor and critic, as encoding is most of the work.

    Their gradients add up in the encoder, and errors of values grow with the returns, which are 1 / (1 - gamma) at
    most: `critic_coeff` in `objective` keeps them from drowning the policy's.
    """
    return TrainingCfg(
        num_envs=num_envs,
        # Values reach 100 here: clipping their change to 0.2 would stop the critic from learning.
        objective=PPOCfg(clip_value=False, schedule="fixed", num_epochs=4, **objective),
        data=data,
        modules=ModulesCfg(
            trunk=SharedTrunkCfg(encoders={"actor": EncoderCfg()}, hidden_dims=(256,)),
            actor=ActorCfg(
                in_keys=(FEATURES,),
                hidden_dims=(64,),
                init_std=init_std,
                obs_normalization=False,
            ),
            critic=CriticCfg(in_keys=(FEATURES,), hidden_dims=(64,), obs_normalization=False),
        ),
        trainer=TrainerCfg(num_iterations=num_iterations, eval_interval=eval_interval),
    )


def _fast_sac_training(*, num_iterations: int, v_max: float) -> TrainingCfg:
    """Return FastSAC with an encoder each for actor and critics, and pictures that move by 4 pixels as in DrQ-v2.

    An iteration is one step of 256 envs and 2 gradient steps. The replay takes 3.2 GB for 64 x 64 pixels in colour, and
    is left out of checkpoints; `v_max` is the highest return that critics can tell.
    """
    # Where each channel is brightest: 128 numbers instead of 1024 before layers of some hundred.
    encoders = {"actor": EncoderCfg(spatial_softmax=True)}
    return TrainingCfg(
        num_envs=256,
        objective=FastSACCfg(
            gamma=0.99,
            tau=0.02,
            policy_delay=2,
            target_entropy_per_action=-1.0,
            random_shift=4,
            compile=True,
        ),
        data=ReplayCfg(
            num_env_states_per_minibatch=1024,
            num_minibatches=2,
            n_step=3,
            learning_starts=20,
            save_replay=False,
        ),
        modules=ModulesCfg(
            actor=replace(
                fast_sac.ACTOR,
                in_keys=("actor",),
                encoders=encoders,
                hidden_dims=(256, 128),
                obs_normalization=False,
            ),
            critic=replace(
                fast_sac.CRITIC,
                in_keys=("actor",),
                encoders=encoders,
                hidden_dims=(256, 128),
                num_atoms=51,
                v_min=0.0,
                v_max=v_max,
                obs_normalization=False,
            ),
        ),
        trainer=TrainerCfg(num_iterations=num_iterations, eval_interval=num_iterations // 10),
    )


# -- a pole on a cart --------------------------------------------------------------------------------------------


def cartpole_balance_pixels() -> ManagerBasedRlEnvCfg:
    """Return the config of `cartpole_balance` seen by a camera beside the rail.

    "actor" has three pictures 40 ms apart, uint8 [E, 3, 64, 64, 3], in which speeds can be seen; "critic" has the
    state, which nothing reads unless `modules.critic.in_keys` says so.
    """
    # As near as the pole's tip allows, at 2 cm per pixel: how fast the pole falls is hardly to be seen from twice as
    # far. Of the rail 1.3 m are seen; a cart farther out is not.
    camera = CameraSensor(pos=(0.0, -1.6, 1.4), xyaxes=FROM_THE_SIDE, width=64, height=64)
    return _seen(cartpole_balance(), camera, steps_between_frames=4)


def cartpole_swingup_pixels() -> ManagerBasedRlEnvCfg:
    """Return the config of `cartpole_swingup` seen as in `cartpole_balance_pixels`, from farther away."""
    # 3.3 of 3.6 m of the rail: the cart goes farther here than for a pole that is up.
    camera = CameraSensor(pos=(0.0, -4.0, 1.0), xyaxes=FROM_THE_SIDE, width=64, height=64)
    return _seen(cartpole_swingup(), camera, steps_between_frames=4)


CARTPOLE_BALANCE_PIXELS = Task(
    name="cartpole_balance_pixels",
    description="keep a pole upright on a cart, by pictures of 64 x 64 pixels alone",
    cfg=cartpole_balance_pixels,
    training=_training(
        num_envs=1024,
        data=DatasetCfg(num_env_states_per_minibatch=2048, num_minibatches=8),
        num_iterations=120,
        eval_interval=10,
        # With larger random forces the pole falls before much is seen.
        init_std=0.5,
        learning_rate=5e-4,
        entropy_coeff=0.0,
        critic_coeff=0.005,
    ),
    # Rewards are 1 per step at most, so returns 1 / (1 - 0.99).
    other_trainings=(_fast_sac_training(num_iterations=6_000, v_max=100.0),),
    solved_at=900.0,
)
CARTPOLE_SWINGUP_PIXELS = Task(
    name="cartpole_swingup_pixels",
    description="swing a hanging pole up, by pictures of 64 x 64 pixels alone",
    cfg=cartpole_swingup_pixels,
    training=_training(
        num_envs=1024,
        data=DatasetCfg(num_env_states_per_minibatch=4096, num_minibatches=8),
        num_iterations=400,
        eval_interval=20,
        learning_rate=5e-4,
        gamma=0.995,
        entropy_coeff=0.003,
        # Values are twice as high as with 0.99, and so are the weights through which their errors reach the encoder.
        critic_coeff=0.00125,
    ),
    # As of `cartpole_swingup`.
    solved_at=800.0,
)


# -- an arm with two joints --------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class ReacherBesideTarget(Reacher):
    """The reacher, and a ball that shows its target: the mocap body "target", which touches nothing."""

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        spec = super().spec()
        target = spec.worldbody.add_body(
            name="target", mocap=True, pos=[0.2, 0.0, self.plane_height]
        )
        target.add_geom(
            name="target",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[TARGET_RADIUS, 0.0, 0.0],
            rgba=[0.1, 0.7, 0.2, 1.0],
            contype=0,
            conaffinity=0,
        )
        return spec


@dataclass(frozen=True, kw_only=True)
class SeenReacherTarget(ReacherTarget):
    """A `ReacherTarget` at which the mocap body "target" stands, so that pictures show it."""

    def resample(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        super().resample(view, mask_E)
        mocap = int(view.world.mj_model.body_mocapid[view.resolver.one("body", "target")])
        shown_E2 = view.world.view("mocap_pos")[:, mocap, :2]
        # In place, and in the drawn rows only: nothing else moves it but resets, which draw too.
        shown_E2.copy_(torch.where(mask_E[:, None], self.held(view), shown_E2))


def reacher_pixels() -> ManagerBasedRlEnvCfg:
    """Return the config of `reacher` seen from above, with a green ball as target.

    "actor" has three pictures 40 ms apart, uint8 [E, 3, 64, 64, 3]; "critic" has the state, which nothing reads unless
    `modules.critic.in_keys` says so.
    """
    cfg = reacher()
    # 0.52 m of the finger's plane, which is all that the arm reaches: 8 mm per pixel.
    camera = CameraSensor(pos=(0.0, 0.0, 0.65), xyaxes=FROM_ABOVE, width=64, height=64)
    cfg = replace(
        cfg,
        scene=replace(cfg.scene, robots={"reacher": ReacherBesideTarget()}),
        commands={"target": SeenReacherTarget(resampling_time_range_s=(20.0, 20.0))},
    )
    return _seen(cfg, camera, steps_between_frames=2)


REACHER_PIXELS = Task(
    name="reacher_pixels",
    description="a planar arm reaches a ball, by pictures of 64 x 64 pixels alone",
    cfg=reacher_pixels,
    training=_training(
        num_envs=1024,
        data=DatasetCfg(num_env_states_per_minibatch=4096, num_minibatches=8),
        num_iterations=400,
        eval_interval=20,
        learning_rate=5e-4,
        entropy_coeff=0.0,
        critic_coeff=0.005,
    ),
    # As of `reacher`.
    solved_at=930.0,
)
