"""The term library holds what observations, rewards, events and the rest of a task are put together from.

A term is public once it is imported here.
"""
# ruff: noqa: F401

from ksim_rl.mdp.actions import (
    ActuatorAction,
    JointEffortAction,
    JointPositionAction,
    JointPositionVelocityAction,
    JointVelocityAction,
    RelativeJointPositionAction,
)
from ksim_rl.mdp.commands.locomotion import JoystickCommand, SinusoidalGaitCommand, UniformVelocityCommand
from ksim_rl.mdp.commands.pose import (
    BaseHeightCommand,
    CartesianCommand,
    JointPositionCommand,
    StartPoseCommand,
)
from ksim_rl.mdp.curricula import (
    CommandRangesByLevel,
    CommandRangesByStage,
    DistanceLevel,
    EpisodeLengthLevel,
    LinearLevel,
    RewardWeightByLevel,
    RewardWeightByStage,
    SaturationLevel,
    TerrainLevels,
)
from ksim_rl.mdp.events import (
    Jump,
    PushByForce,
    PushByVelocity,
    ResetHeading,
    ResetHeight,
    ResetJoints,
    ResetJointsByScale,
    ResetRootUniform,
)
from ksim_rl.mdp.manipulation import NearBody, OffsetToBody, OffsetToCommand
from ksim_rl.mdp.metrics import (
    ActionAcceleration,
    AngularVelocityError,
    CostOfTransport,
    FootSlipSpeed,
    LinearVelocityError,
    PeakContactForce,
    PeakFootHeight,
    Power,
    Success,
    TargetReached,
)
from ksim_rl.mdp.motion_tracking import (
    FarFromMotion,
    MotionBodyOffset,
    MotionFinished,
    MotionJoints,
    MotionPhase,
    ResetToMotion,
    TrackMotionBodyPos,
    TrackMotionBodyQuat,
    TrackMotionJointPos,
    TrackMotionJointVel,
)
from ksim_rl.mdp.observations.bodies import (
    BodyAngVel,
    BodyLinVel,
    BodyPos,
    BodyQuat,
    BodyRotation6d,
    CenterOfMassPos,
    CenterOfMassVel,
    Contact,
    ContactForce,
    FootAirTime,
    FootContact,
    FootContactForces,
    FootHeight,
    FootPos,
)
from ksim_rl.mdp.observations.joints import (
    ActuatorForce,
    JointAcc,
    JointEffort,
    JointPos,
    JointPosRel,
    JointVel,
)
from ksim_rl.mdp.observations.root import (
    Clock,
    Command,
    EpisodeTime,
    LastAction,
    ProjectedGravity,
    RemainingTime,
    RootAngVel,
    RootLinVel,
    RootPos,
    RootQuat,
    RootRotation6d,
    SensorReading,
)
from ksim_rl.mdp.observations.sensors import CameraImage, HeightScan, ImuReading, RayDistance, RayHeight
from ksim_rl.mdp.randomization.actuators import RandomizeActuatorGains, RandomizeEffortLimit
from ksim_rl.mdp.randomization.bodies import (
    RandomizeBodyCom,
    RandomizeBodyInertia,
    RandomizeBodyMass,
    RandomizeGravity,
    RandomizePseudoInertia,
)
from ksim_rl.mdp.randomization.geoms import (
    RandomizeGeomFriction,
    RandomizeGeomPos,
    RandomizeGeomQuat,
    RandomizeGeomSize,
)
from ksim_rl.mdp.randomization.joints import (
    RandomizeDefaultJointPos,
    RandomizeEncoderBias,
    RandomizeJointArmature,
    RandomizeJointDamping,
    RandomizeJointFrictionLoss,
    RandomizeJointRange,
    RandomizeJointStiffness,
    RandomizeJointZero,
)
from ksim_rl.mdp.rewards.actions import (
    ActionAccelerationL2,
    ActionJerkL2,
    ActionRateL2,
    ActionSymmetryL2,
    Alive,
    JointSymmetryL2,
    Terminated,
)
from ksim_rl.mdp.rewards.feet import (
    ContactForceAbove,
    FeetAirTime,
    FootClearance,
    FootSlip,
    FootSwingHeight,
    GaitPhase,
    SelfCollision,
    SoftLanding,
    UndesiredContacts,
)
from ksim_rl.mdp.rewards.joints import (
    ActuatorForceL2,
    Energy,
    JointAccL2,
    JointDeviationL1,
    JointDeviationL2,
    JointEffortL2,
    JointEffortLimits,
    JointPosLimits,
    JointVelL2,
    JointVelLimits,
)
from ksim_rl.mdp.rewards.posture import (
    AngularMomentum,
    AngVelXYL2,
    BodyAngularVelocity,
    LinkAccelerationL2,
    LinVelZL2,
    MotionlessAtRest,
    Pose,
    RootHeightL2,
    TiltL2,
    Upright,
)
from ksim_rl.mdp.rewards.tracking import (
    TrackAngularVelocity,
    TrackJointPosition,
    TrackLinearVelocity,
    TrackOrientation,
    TrackPosition,
    TrackRootHeight,
)
from ksim_rl.mdp.terminations import (
    BadOrientation,
    FarFromOrigin,
    IllegalContact,
    JointLimitViolated,
    JointVelocityAbove,
    NonFiniteState,
    OutsideTerrain,
    RootHeightBelow,
    RootVelocityAbove,
    TimeOut,
)

__all__ = sorted(name for name, value in globals().items() if isinstance(value, type))  # pyright: ignore
