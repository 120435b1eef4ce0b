"""Two chains of three hinges, small enough to be computed by hand beside the C engine."""

from collections.abc import Sequence
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import nn

from ksim_rl.envs import MjcfRobot
from ksim_rl.envs.driver import EnvDriver
from ksim_rl.physics import World, load_model
from ksim_rl.scene.actuators import (
    Actuator,
    DCMotorActuator,
    DelayedActuator,
    IdealPDActuator,
    JointDrives,
    LSTMActuator,
    MLPActuator,
    PositionActuator,
)

JOINTS = ("hip", "knee", "ankle", "neck", "elbow", "wrist")
TIMESTEP = 0.002


def _link(names: Sequence[str]) -> str:
    if not names:
        return ""
    return f"""
      <body name="{names[0]}" pos="0 0 -0.2">
        <joint name="{names[0]}" axis="0 1 0" armature="0.05" range="-3 3" limited="true"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.2" mass="0.5" contype="0" conaffinity="0"/>
        {_link(names[1:])}
      </body>"""


CHAINS = f"""
<mujoco>
  <compiler angle="radian"/>
  <option timestep="{TIMESTEP}" integrator="implicitfast"/>
  <worldbody>
    {_link(JOINTS[:3])}
    <body pos="1 0 0">{_link(JOINTS[3:])}</body>
  </worldbody>
  <keyframe><key name="rest" qpos="0.1 -0.2 0.3 -0.1 0.2 -0.3"/></keyframe>
</mujoco>
"""

LSTM_SIZE, LSTM_LAYERS = 5, 2
MLP_LAGS = (0, 2, 3)


class RecurrentMotor(nn.Module):
    """What an LSTMActuator's file holds."""

    def __init__(self) -> None:
        super().__init__()
        self.lstm = nn.LSTM(2, LSTM_SIZE, LSTM_LAYERS, batch_first=True)
        self.head = nn.Linear(LSTM_SIZE, 1)

    def forward(self, inputs_NTF: torch.Tensor) -> torch.Tensor:
        return self.head(self.lstm(inputs_NTF)[0])[..., 0]


def recurrent_module() -> RecurrentMotor:
    """Return a recurrent motor with random weights, always the same."""
    with torch.random.fork_rng():
        torch.manual_seed(3)
        module = RecurrentMotor().requires_grad_(False)
    module.lstm.load_state_dict(
        {name: 3.0 * weight for name, weight in module.lstm.state_dict().items()}
    )
    module.head.bias.zero_()
    return module


def feed_forward_module() -> nn.Sequential:
    """Return a feed-forward motor with softsign and random weights, always the same."""
    with torch.random.fork_rng():
        torch.manual_seed(4)
        return nn.Sequential(
            nn.Linear(2 * len(MLP_LAGS), 8),
            nn.Softsign(),
            nn.Linear(8, 6),
            nn.Softsign(),
            nn.Linear(6, 1),
        ).requires_grad_(False)


def written(module: nn.Module, folder: Path, **metadata: str) -> str:
    """Write the weights of a motor; return the path of the file."""
    file = folder / f"{type(module).__name__}.safetensors"
    save_file(module.state_dict(), file, metadata=metadata or None)
    return str(file)


def one_of_each(folder: Path) -> tuple[Actuator, ...]:
    """Return an actuator of another kind for each joint, in another order than the joints'."""
    lstm = written(recurrent_module(), folder, effort_scale="8.0", velocity_scale="0.1")
    mlp = written(
        feed_forward_module(), folder, activation="softsign", input_lags=str(list(MLP_LAGS))
    )
    pd = {"stiffness": 20.0, "damping": 0.8, "effort_limit": 4.0}
    return (
        LSTMActuator(joints="elbow", file=lstm, effort_limit=3.0),
        DelayedActuator(
            actuator=PositionActuator(
                joints="ankle", stiffness=15.0, damping=0.5, effort_limit=5.0
            ),
            min_lag=1,
            max_lag=6,
        ),
        IdealPDActuator(joints="knee", **pd),
        MLPActuator(joints="wrist", file=mlp, effort_scale=12.0, effort_limit=2.5),
        DelayedActuator(actuator=IdealPDActuator(joints="neck", **pd), max_lag=5),
        DCMotorActuator(joints="hip", saturation_effort=5.0, velocity_limit=6.0, **pd),
    )


class ChainBench:
    """Worlds of the chains with some actuators, and their motor models at work, without an env."""

    def __init__(self, *actuators: Actuator, num_envs: int = 3) -> None:
        spec = MjcfRobot(source=CHAINS, actuators=actuators).spec()
        self.world = World(load_model(spec), num_envs=num_envs)
        self.driver = EnvDriver(self.world, step_dt=4 * TIMESTEP)
        self.view = self.driver.view
        self.drives = JointDrives({"": actuators}, self.driver, self.view)
        self.driver.freeze()
        self.reset(*range(num_envs))

    def reset(self, *rows: int) -> None:
        """Reset these rows, as the env does."""
        mask_E = torch.zeros(self.world.num_envs, dtype=torch.bool)
        mask_E[list(rows)] = True
        self.view.reset_count_E.add_(mask_E)
        self.view.buffers.clear(mask_E)
        self.drives.reset(mask_E)

    def efforts(self, joint: str) -> torch.Tensor:
        """Let the motor models write their controls; return one joint's, [E]."""
        for hook in self.driver.before_substep:
            hook()
        return self.world.ctrl_EL[:, self.world.mj_model.actuator(joint).id].clone()

    def move(self, joint: str, *, pos=None, vel=None) -> None:
        """Put one joint somewhere, a number or one per row."""
        column = JOINTS.index(joint)
        for values, target in ((pos, self.world.qpos_EL), (vel, self.world.qvel_EL)):
            if values is not None:
                target[:, column] = torch.as_tensor(values)
