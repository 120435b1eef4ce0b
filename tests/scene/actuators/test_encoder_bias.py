"""A servo closes its loop over an encoder with a bias: at rest the encoder reads the target, not the joint's angle."""

import pytest
import torch

from ksim_rl import mdp
from ksim_rl.envs import (
    ManagerBasedRlEnv,
    ManagerBasedRlEnvCfg,
    MjcfRobot,
    ObservationGroupCfg,
    SceneCfg,
)
from ksim_rl.scene.actuators import DelayedActuator, IdealPDActuator, PositionActuator
from ksim_rl.transforms import ObservationTermCfg

# Without gravity a servo rests exactly where its effort is 0.
HINGES = """
<mujoco>
  <option timestep="0.004" gravity="0 0 0" integrator="implicitfast"/>
  <worldbody>
    <body><joint name="near" axis="0 1 0" armature="0.05"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0" mass="0.2"/></body>
    <body pos="0 1 0"><joint name="far" axis="0 1 0" armature="0.05"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0" mass="0.2"/></body>
  </worldbody>
  {actuators}
  <keyframe><key qpos="0.2 -0.1"/></keyframe>
</mujoco>
"""
# Targets become controls by `50 q / 0.4`: the bias must be taken off before that, not after it.
MODEL_SERVOS = """
<actuator>
  <general joint="far" gainprm="0.4" biasprm="-51 -50 -5" biastype="affine"/>
  <position joint="near" kp="50" kv="5" gear="2"/>
</actuator>
"""
GAINS = {"joints": ".*", "stiffness": 40.0, "damping": 4.0}
SERVOS = {
    "of the model": (MODEL_SERVOS, ()),
    "of MuJoCo": ("", (PositionActuator(**GAINS),)),
    "PD law": ("", (IdealPDActuator(**GAINS),)),
    "late PD law": ("", (DelayedActuator(actuator=IdealPDActuator(**GAINS), max_lag=3),)),
    "late servo": ("", (DelayedActuator(actuator=PositionActuator(**GAINS), max_lag=3),)),
}
BIAS = (0.04, -0.03)
"""rad, of the joints "near" and "far"; drawn from a range without width, so that each env has it."""


def make(servo: str, action=None) -> ManagerBasedRlEnv:
    actuators, entries = SERVOS[servo]
    group = ObservationGroupCfg(
        terms={
            "read": ObservationTermCfg(term=mdp.JointPos(biased=True)),
            "true": ObservationTermCfg(term=mdp.JointPos()),
        }
    )
    near, far = ((bias, bias) for bias in BIAS)
    return ManagerBasedRlEnv(
        ManagerBasedRlEnvCfg(
            decimation=5,
            scene=SceneCfg(
                robots={
                    "hinges": MjcfRobot(
                        source=HINGES.format(actuators=actuators), actuators=entries
                    )
                },
                num_envs=2,
            ),
            observations={"actor": group},
            actions={"turn": action or mdp.JointPositionAction(joints=("far", "near"))},
            events={
                "near": mdp.RandomizeEncoderBias(joints="near", ranges=near),
                "far": mdp.RandomizeEncoderBias(joints="far", ranges=far),
            },
            seed=0,
        )
    )


def step(env, root_E, action_EK, *, times=1):
    for _ in range(times):
        root_E = env.step(root_E.set("action", action_EK))["next"]
    return root_E


@pytest.mark.parametrize("servo", SERVOS)
def test_at_rest_the_encoder_reads_the_target(servo):
    env = make(servo)
    action_E2 = torch.tensor([[0.3, -0.2], [0.0, 0.1]])
    root_E = step(env, env.reset(), action_E2, times=150)
    asked_E2 = torch.tensor([0.2, -0.1]) + action_E2.flip(-1)
    torch.testing.assert_close(root_E["obs", "read"], asked_E2, atol=1e-4, rtol=0)
    torch.testing.assert_close(
        root_E["obs", "true"], asked_E2 - torch.tensor(BIAS), atol=1e-4, rtol=0
    )
    # What terms read as the target is what the policy asked for.
    torch.testing.assert_close(env.view.joint_pos_target_EL, asked_E2)


@pytest.mark.parametrize("servo", ["of the model", "PD law"])
def test_after_a_reset_servos_hold_the_encoders_at_the_default_pose(servo):
    env = make(servo)
    env.reset()
    # No action: targets and controls stay as the reset set them.
    for _ in range(75):
        # A graph of ten substeps is recorded once; one of all would take seconds.
        env.world.step(10, before=env.driver.before_substep)
    expected_2 = torch.tensor([0.2 - BIAS[0], -0.1 - BIAS[1]])
    torch.testing.assert_close(env.world.qpos_EL, expected_2.expand(2, 2), atol=1e-4, rtol=0)


def test_an_action_from_where_the_joint_is_does_not_depend_on_the_bias():
    env = make("of MuJoCo", mdp.RelativeJointPositionAction(joints=("near", "far")))
    step(env, env.reset(), torch.full((2, 2), 0.1))
    torch.testing.assert_close(env.world.ctrl_EL, torch.tensor([0.3, 0.0]).expand(2, 2))


def test_a_bias_that_changes_moves_what_is_held():
    env = make("of MuJoCo")
    env.reset()
    env.view.encoder_bias_EL[1] = 0.5
    env.view.targets.follow_bias(torch.tensor([False, True]))
    torch.testing.assert_close(env.world.ctrl_EL[0], torch.tensor([0.2 - BIAS[0], -0.1 - BIAS[1]]))
    torch.testing.assert_close(env.world.ctrl_EL[1], torch.tensor([-0.3, -0.6]))
