"""Fits actuator networks to a log with measured efforts, for the motors that `MLPActuator` simulates.

From errors of position and velocities, now and some time ago, a network tells the effort, as in Hwangbo et al.,
"Learning agile and dynamic motor skills for legged robots", Science Robotics 4 (2019). Joints whose motors the robot's
files give the same numbers share one. The end of the log is held out: how far a network is off there is how good it is.
"""

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from safetensors.torch import save
from torch import Tensor, nn

from ksim_rl.identification.held_robot import DrivenJoint, HeldRobot
from ksim_rl.identification.joint_log import JointLog
from ksim_rl.identification.motor_signals import MotorSignals, motor_signals
from ksim_rl.scene.actuators import MLPActuator
from ksim_rl.scene.actuators.nets import ACTIVATIONS

Array = np.ndarray
PAST_S = (0.0, 0.005, 0.01, 0.02, 0.04)
"""How long ago a network sees errors and velocities; commands that arrive later are beyond it."""
ACTIVATION = "softsign"
WIDTH = 32
NUM_STEPS = 6000
MINIBATCH = 512
LEARNING_RATE = 3e-3
HELD_OUT = 0.2
"""Share of the log, at its end."""
MOST_ERROR = 0.3
"""Of a network that is worth something, as a share of the efforts."""


@dataclass(frozen=True, kw_only=True)
class FittedNet:
    """A network as `MLPActuator` reads it, and how far it is off.

    Attributes:
        joints: whose motors it is.
        file: the content of a safetensors file.
        error: the root mean square of its errors in the held-out seconds, as a share of the efforts' there.
        pd_error: the same of the best proportional-derivative law with a delay, which is fitted to the same seconds.
        held_out_s: how much was held out, s.
    """

    joints: tuple[DrivenJoint, ...]
    file: bytes
    error: float
    pd_error: float
    held_out_s: float

    @property
    def name(self) -> str:
        """The first of its joints."""
        return self.joints[0].name

    @property
    def doubt(self) -> str:
        """Why it should not be used, in one line; empty for a good one."""
        if not self.error <= MOST_ERROR:
            return (
                f"the network of {self.name!r} does not explain {self.error:.0%} of the efforts in the held-out "
                "seconds: are they measured at the same time as the positions, and does nothing touch?"
            )
        if self.error >= self.pd_error:
            return (
                f"the network of {self.name!r} is no better than a proportional-derivative law "
                f"({self.error:.1%} and {self.pd_error:.1%} off): use its gains, `ksim-rl identify` without --nets"
            )
        return ""

    def entry(self, file: Path) -> MLPActuator:
        """Return the actuator that drives these joints with the network in `file`."""
        first = self.joints[0]
        return MLPActuator(
            joints=tuple(joint.name for joint in self.joints),
            effort_limit=first.effort_limit if math.isfinite(first.effort_limit) else None,
            armature=first.nominal["armature"],
            frictionloss=first.nominal["frictionloss"],
            file=str(file),
            sha256=hashlib.sha256(self.file).hexdigest(),
        )


def fit_nets(
    robot: HeldRobot,
    log: JointLog,
    *,
    timestep: float,
    seed: int = 0,
    num_steps: int = NUM_STEPS,
    note: Callable[[str], None] = lambda _: None,
) -> list[FittedNet]:
    """Return a network for each kind of motor, for a simulation in steps of `timestep`, s.

    A ValueError names what the log lacks.
    """
    signals = motor_signals(robot, log, timestep)
    places: dict[tuple[float, ...], list[int]] = {}
    for place, joint in enumerate(robot.joints):
        places.setdefault(_motor(joint), []).append(place)
    found = []
    for number, group in enumerate(places.values(), 1):
        joints = tuple(robot.joints[place] for place in group)
        note(f"network {number} of {len(places)}: {', '.join(joint.name for joint in joints)}")
        found.append(_fit_net(joints, _some(signals, group), seed=seed, num_steps=num_steps))
    return found


def _motor(joint: DrivenJoint) -> tuple[float, ...]:
    """Return the numbers in which motors of one kind are equal."""
    own = ("armature", "frictionloss", "stiffness", "servo_damping")
    return (joint.effort_limit, *(joint.nominal[kind] for kind in own))


def _some(signals: MotorSignals, places: Sequence[int]) -> MotorSignals:
    return MotorSignals(
        timestep=signals.timestep,
        error_SN=signals.error_SN[:, places],
        vel_SN=signals.vel_SN[:, places],
        effort_SN=signals.effort_SN[:, places],
    )


def _fit_net(
    joints: tuple[DrivenJoint, ...], signals: MotorSignals, *, seed: int, num_steps: int
) -> FittedNet:
    lags = input_lags(signals.timestep)
    # In what remains each step knows its past.
    first = max(lags)
    split = first + int((1.0 - HELD_OUT) * (len(signals.effort_SN) - first))
    # No step of the held-out seconds sees one that was learned from.
    held_out = slice(split + first, None)
    learned = slice(first, split)
    position_scale = 1.0 / float(signals.error_SN[learned].std())
    velocity_scale = 1.0 / float(signals.vel_SN[learned].std())
    effort_scale = float(signals.effort_SN[learned].std())
    errors_SNK = _past(signals.error_SN, lags)
    velocities_SNK = _past(signals.vel_SN, lags)
    inputs_SNF = np.concatenate(
        (position_scale * errors_SNK, velocity_scale * velocities_SNK), axis=-1
    )
    net = _train(
        torch.from_numpy(inputs_SNF[learned]).float().flatten(0, 1),
        torch.from_numpy(signals.effort_SN[learned] / effort_scale).float().flatten(),
        seed=seed,
        num_steps=num_steps,
    )
    with torch.no_grad():
        said_SN1 = net(torch.from_numpy(inputs_SNF[held_out]).float())
    true_SN = signals.effort_SN[held_out]
    gains_2, lag = _best_law(
        errors_SNK[learned], velocities_SNK[learned], signals.effort_SN[learned]
    )
    law_SN = (
        gains_2[0] * errors_SNK[held_out, :, lag] + gains_2[1] * velocities_SNK[held_out, :, lag]
    )
    metadata = {
        "activation": ACTIVATION,
        "input_lags": json.dumps(list(lags)),
        "position_scale": repr(position_scale),
        "velocity_scale": repr(velocity_scale),
        "effort_scale": repr(effort_scale),
    }
    return FittedNet(
        joints=joints,
        file=save(net.state_dict(), metadata),
        error=_share(effort_scale * said_SN1[..., 0].numpy(), true_SN),
        pd_error=_share(law_SN, true_SN),
        held_out_s=len(true_SN) * signals.timestep,
    )


def input_lags(timestep: float) -> tuple[int, ...]:
    """Return the physics steps into the past that a network sees, the present first."""
    lags = {round(past_s / timestep) for past_s in PAST_S}
    return tuple(sorted(lags))


def _past(values_SN: Float[Array, "S N"], lags: Sequence[int]) -> Float[Array, "S N K"]:
    """Return the values at all lags; before the first step lies the first value, which is not learned from."""
    columns = []
    for lag in lags:
        before = np.repeat(values_SN[:1], lag, axis=0)
        columns.append(np.concatenate((before, values_SN[: len(values_SN) - lag])))
    return np.stack(columns, axis=-1)


def _train(
    seen_KF: Float[Tensor, "K F"], wanted_K: Float[Tensor, " K"], *, seed: int, num_steps: int
) -> nn.Sequential:
    """Return a network that was fitted by Adam, at a rate that falls to zero."""
    activation = ACTIVATIONS[ACTIVATION]
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = nn.Sequential(
            nn.Linear(seen_KF.shape[1], WIDTH),
            activation(),
            nn.Linear(WIDTH, WIDTH),
            activation(),
            nn.Linear(WIDTH, 1),
        )
    optimizer = torch.optim.Adam(net.parameters(), lr=LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, T_max=num_steps)
    with _one_thread():
        for _ in range(num_steps):
            chosen_B = torch.randint(len(seen_KF), (MINIBATCH,), generator=generator)
            said_B = net(seen_KF[chosen_B])[:, 0]
            loss = (said_B - wanted_K[chosen_B]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return net


@contextmanager
def _one_thread() -> Iterator[None]:
    """Keep torch to one thread: in so small a network several wait for each other, ten times as long on busy cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _best_law(
    errors_SNK: Float[Array, "S N K"],
    velocities_SNK: Float[Array, "S N K"],
    effort_SN: Float[Array, "S N"],
) -> tuple[Float[Array, " 2"], int]:
    """Return gains and lag of the proportional-derivative law that leaves least."""
    found = []
    for lag in range(errors_SNK.shape[-1]):
        seen_K2 = np.stack((errors_SNK[..., lag].ravel(), velocities_SNK[..., lag].ravel()), axis=1)
        gains_2 = np.linalg.lstsq(seen_K2, effort_SN.ravel(), rcond=None)[0]
        left = _share(seen_K2 @ gains_2, effort_SN.ravel())
        found.append((left, lag, gains_2))
    _, lag, gains_2 = min(found, key=lambda entry: entry[:2])
    return gains_2, lag


def _share(said: Array, true: Array) -> float:
    """Return the root mean square of the prediction error, as a share of the truth's."""
    return float(np.sqrt(np.mean((said - true) ** 2) / np.mean(true**2)))
