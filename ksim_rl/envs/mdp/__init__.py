"""The term library: what observations, rewards, events and the rest of a task are put together from."""

from ksim_rl.envs.mdp.actions import JointEffortAction, JointPositionAction
from ksim_rl.envs.mdp.commands import UniformVelocityCommand
from ksim_rl.envs.mdp.events import PushByVelocity, ResetJoints, ResetRootUniform
from ksim_rl.envs.mdp.metrics import ActionAcceleration, AngularVelocityError, LinearVelocityError
from ksim_rl.envs.mdp.observations import (
    Command,
    FootAirTime,
    FootContact,
    FootContactForces,
    FootHeight,
    JointPos,
    JointPosRel,
    JointVel,
    LastAction,
    ProjectedGravity,
    RootAngVel,
    RootLinVel,
    RootPos,
    RootQuat,
    SensorReading,
)
from ksim_rl.envs.mdp.randomize import RandomizeBodyCom, RandomizeEncoderBias, RandomizeGeomFriction
from ksim_rl.envs.mdp.rewards import ActionRateL2, ActuatorForceL2, Alive, JointVelL2
from ksim_rl.envs.mdp.rewards_feet import FeetAirTime, FootClearance, FootSlip, FootSwingHeight, SoftLanding
from ksim_rl.envs.mdp.rewards_posture import (
    AngularMomentum,
    BodyAngularVelocity,
    JointPosLimits,
    Pose,
    Upright,
)
from ksim_rl.envs.mdp.rewards_tracking import TrackAngularVelocity, TrackLinearVelocity
from ksim_rl.envs.mdp.terminations import BadOrientation, RootHeightBelow, TimeOut

__all__ = [
    "ActionAcceleration",
    "ActionRateL2",
    "ActuatorForceL2",
    "Alive",
    "AngularMomentum",
    "AngularVelocityError",
    "BadOrientation",
    "BodyAngularVelocity",
    "Command",
    "FeetAirTime",
    "FootAirTime",
    "FootClearance",
    "FootContact",
    "FootContactForces",
    "FootHeight",
    "FootSlip",
    "FootSwingHeight",
    "JointEffortAction",
    "JointPos",
    "JointPosLimits",
    "JointPosRel",
    "JointPositionAction",
    "JointVel",
    "JointVelL2",
    "LastAction",
    "LinearVelocityError",
    "Pose",
    "ProjectedGravity",
    "PushByVelocity",
    "RandomizeBodyCom",
    "RandomizeEncoderBias",
    "RandomizeGeomFriction",
    "ResetJoints",
    "ResetRootUniform",
    "RootAngVel",
    "RootHeightBelow",
    "RootLinVel",
    "RootPos",
    "RootQuat",
    "SensorReading",
    "SoftLanding",
    "TimeOut",
    "TrackAngularVelocity",
    "TrackLinearVelocity",
    "Upright",
    "UniformVelocityCommand",
]
