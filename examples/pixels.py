"""Trains a policy that sees: from a model with a camera to a policy, top to bottom, in one file.

    python examples/pixels.py                       # about a minute on a CPU
    python examples/pixels.py num_iterations=10 num_envs=32

A puck on a rail has to go to a ball, which lies somewhere along it. Where it lies is seen in a picture of 12 x 32
pixels from above, and nowhere else: the policy reads pictures, its critic the positions. docs/vision.md has the rest.
"""

import sys
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl import envs
from ksim_rl.collectors import RolloutCollector
from ksim_rl.data import DatasetCfg
from ksim_rl.envs import (
    CameraSensor,
    EnvView,
    ManagerBasedRlEnvCfg,
    MjcfRobot,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTerm,
    SceneCfg,
    mdp,
)
from ksim_rl.envs.transforms import Brightness, PictureEffects, PixelNoise, TransformCfg
from ksim_rl.modules import ActorCfg, CriticCfg, EncoderCfg, make_actor, make_critic, make_for_spec
from ksim_rl.objectives import PPOCfg
from ksim_rl.trainers import Evaluator, PPOUpdate

# ---- the world: what moves, and what sees it ------------------------------------------------------------------------

MODEL = """
<mujoco model="rail">
  <option timestep="0.01" integrator="implicitfast" gravity="0 0 0"><flag contact="disable"/></option>
  <worldbody>
    <geom type="plane" size="2 1 0.1" pos="0 0 -0.1" rgba="0.2 0.2 0.25 1"/>
    <light pos="0 0 3" dir="0 0 -1" type="directional"/>
    <body name="puck">
      <joint name="puck" type="slide" axis="1 0 0" range="-1 1" limited="true"/>
      <geom type="box" size="0.1 0.1 0.05" pos="0 -0.2 0" mass="1" rgba="0.2 0.4 1 1"/>
    </body>
    <body name="ball">
      <joint name="ball" type="slide" axis="1 0 0" damping="100"/>
      <geom type="sphere" size="0.12" pos="0 0.2 0" mass="1" rgba="1 0.3 0.1 1"/>
    </body>
  </worldbody>
  <actuator><position name="puck" joint="puck" kp="200" dampratio="1"/></actuator>
</mujoco>
"""
# Looks down from 2 m, with x to the right: 2.7 m of the rail in 32 columns.
CAMERA = CameraSensor(
    pos=(0.0, 0.0, 2.0),
    xyaxes=(1.0, 0.0, 0.0, 0.0, 1.0, 0.0),
    fovy=28.0,
    width=32,
    height=12,
    textures=False,
)


# ---- the task: what is wanted, and who may know what ----------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Near(RewardTerm):
    """1 where the puck is at the ball, less by their distance, m; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        """Return the unweighted reward."""
        puck_E1 = view.joints("puck").pos_EL
        ball_E1 = view.joints("ball").pos_EL
        return 1.0 - (puck_E1 - ball_E1).abs().squeeze(-1)


def make_cfg(num_envs: int) -> ManagerBasedRlEnvCfg:
    """Return the config of the env."""
    picture = ObservationTermCfg(term=mdp.CameraImage(sensor="above"))
    positions = ObservationTermCfg(term=mdp.JointPos(joints=("puck", "ball")))
    # The light is another one in each episode, and each pixel has noise: a camera's, not a renderer's.
    look = TransformCfg(
        PictureEffects,
        in_keys=["picture"],
        effects={"light": Brightness(each="episode"), "noise": PixelNoise(std=0.02)},
    )
    return ManagerBasedRlEnvCfg(
        decimation=5,
        scene=SceneCfg(
            robots={"rail": MjcfRobot(source=MODEL)}, sensors={"above": CAMERA}, num_envs=num_envs
        ),
        observations={
            "picture": ObservationGroupCfg(terms={"rgb": picture}),
            "positions": ObservationGroupCfg(terms={"joints": positions}),
        },
        transforms={"look": look},
        actions={"puck": mdp.JointPositionAction(joints=("puck",))},
        events={"reset": mdp.ResetJoints(position_range=(-1.0, 1.0))},
        rewards={"near": Near()},
        terminations={"time_out": mdp.TimeOut()},
        episode_length_s=0.5,
        scale_rewards_by_dt=False,
        seed=0,
    )


# ---- training: networks, data, updates ------------------------------------------------------------------------------


def train(num_iterations: int = 60, num_envs: int = 64) -> float:
    """Train, print a line every ten iterations, and return the mean reward per step of the final policy."""
    torch.manual_seed(0)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    env = envs.build(make_cfg(num_envs), device=device)
    spec = env.observation_spec

    # The encoder tells where in the picture each of its channels is brightest: places are what the task is about.
    encoder = EncoderCfg(channels=(8, 8), kernel_sizes=(3, 3), strides=(1, 1), spatial_softmax=True)
    actor_cfg = ActorCfg(
        in_keys=("picture",), encoders={"picture": encoder}, hidden_dims=(32,), init_std=0.3
    )
    critic_cfg = CriticCfg(in_keys=("positions",), hidden_dims=(32, 32))
    actor = make_for_spec(
        make_actor, actor_cfg, spec, action_spec=env.full_action_spec, device=device
    )
    critic = make_for_spec(make_critic, critic_cfg, spec, device=device)

    update = PPOUpdate(
        PPOCfg(learning_rate=3e-3, schedule="fixed", num_epochs=4, gamma=0.9, clip_value=False),
        actor=actor,
        critic=critic,
        data=DatasetCfg(num_env_states_per_minibatch=4 * num_envs, num_minibatches=4),
        device=device,
    )
    # Rollouts of 16 steps that keep only the leaves that the update reads; pictures stay bytes.
    collector = RolloutCollector(
        env, update.behavior, rollout_length=16, keys=[*update.rollout_keys]
    )
    for iteration in range(1, num_iterations + 1):
        rollout_ET = collector.collect()
        update(rollout_ET)
        if iteration % 10 == 0:
            reward = float(rollout_ET["next", "reward"].mean())
            print(f"iteration {iteration}: reward per step {reward:.3f}", flush=True)

    # ---- evaluation: fresh envs, clean pictures, the policy's best action ------------------------------------------
    fresh = envs.build(make_cfg(num_envs), device=device)
    fresh.eval()
    steps = fresh.base_env.max_episode_length
    score = Evaluator(fresh, actor, max_steps=steps, seed=1)().return_mean / steps
    print(f"the final policy: reward per step {score:.3f}")
    return score


if __name__ == "__main__":
    train(**{name: int(value) for name, value in (word.split("=") for word in sys.argv[1:])})
