"""The term library holds what observations, rewards, events and the rest of a task are put together from.

A term is public once it is imported here.
"""
# ruff: noqa: F401

from ksim_rl.mdp.actions.joints import (
    ActuatorAction,
    JointEffortAction,
    JointPositionAction,
    JointPositionVelocityAction,
    JointVelocityAction,
    RelativeJointPositionAction,
)
from ksim_rl.mdp.commands.gait import SinusoidalGaitCommand
from ksim_rl.mdp.commands.joystick import JoystickCommand
from ksim_rl.mdp.commands.pose import (
    BaseHeightCommand,
    CartesianCommand,
    JointPositionCommand,
    StartPoseCommand,
)
from ksim_rl.mdp.commands.velocity import UniformVelocityCommand
from ksim_rl.mdp.curricula.level import (
    DistanceLevel,
    EpisodeLengthLevel,
    LinearLevel,
    SaturationLevel,
)
from ksim_rl.mdp.curricula.scale import (
    CommandRangesByLevel,
    CommandRangesByStage,
    RewardWeightByLevel,
    RewardWeightByStage,
)
from ksim_rl.mdp.curricula.terrain_levels import TerrainLevels
from ksim_rl.mdp.events.joint_resets import ResetJoints, ResetJointsByScale
from ksim_rl.mdp.events.motion import ResetToMotion
from ksim_rl.mdp.events.pushes import Jump, PushByForce, PushByVelocity
from ksim_rl.mdp.events.root_resets import ResetHeading, ResetHeight, ResetRootUniform
from ksim_rl.mdp.manipulation import NearBody, OffsetToBody, OffsetToCommand
from ksim_rl.mdp.metrics.effort import CostOfTransport, Power
from ksim_rl.mdp.metrics.feet import FootSlipSpeed, PeakContactForce, PeakFootHeight
from ksim_rl.mdp.metrics.motion import ActionAcceleration, AngularVelocityError, LinearVelocityError
from ksim_rl.mdp.metrics.success import Success, TargetReached
from ksim_rl.mdp.motion_tracking import (
    FarFromMotion,
    MotionBodyOffset,
    MotionFinished,
    MotionJoints,
    MotionPhase,
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
)
from ksim_rl.mdp.observations.contacts import (
    Contact,
    ContactForce,
    FootAirTime,
    FootContact,
    FootContactForces,
    FootHeight,
    FootPos,
)
from ksim_rl.mdp.observations.height_scan import HeightScan
from ksim_rl.mdp.observations.joints import (
    ActuatorForce,
    JointAcc,
    JointEffort,
    JointPos,
    JointPosRel,
    JointVel,
)
from ksim_rl.mdp.observations.root import (
    Command,
    LastAction,
    ProjectedGravity,
    RootAngVel,
    RootLinVel,
    RootPos,
    RootQuat,
    RootRotation6d,
    SensorReading,
)
from ksim_rl.mdp.observations.sensors import CameraImage, ImuReading, RayDistance, RayHeight
from ksim_rl.mdp.observations.time import Clock, EpisodeTime, RemainingTime
from ksim_rl.mdp.randomization.actuators import RandomizeActuatorGains, RandomizeEffortLimit
from ksim_rl.mdp.randomization.bodies import RandomizeBodyCom, RandomizeBodyInertia, RandomizeBodyMass
from ksim_rl.mdp.randomization.geoms import (
    RandomizeGeomFriction,
    RandomizeGeomPos,
    RandomizeGeomQuat,
    RandomizeGeomSize,
)
from ksim_rl.mdp.randomization.gravity import RandomizeGravity
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
from ksim_rl.mdp.randomization.pseudo_inertia import RandomizePseudoInertia
from ksim_rl.mdp.rewards.actions import (
    ActionAccelerationL2,
    ActionJerkL2,
    ActionRateL2,
    Alive,
    Terminated,
)
from ksim_rl.mdp.rewards.contacts import ContactForceAbove, SelfCollision, UndesiredContacts
from ksim_rl.mdp.rewards.feet import (
    FeetAirTime,
    FootClearance,
    FootSlip,
    FootSwingHeight,
    GaitPhase,
    SoftLanding,
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
from ksim_rl.mdp.rewards.motion import (
    AngularMomentum,
    AngVelXYL2,
    BodyAngularVelocity,
    LinkAccelerationL2,
    LinVelZL2,
    MotionlessAtRest,
)
from ksim_rl.mdp.rewards.posture import (
    Pose,
    RootHeightL2,
    TiltL2,
    Upright,
)
from ksim_rl.mdp.rewards.symmetry import ActionSymmetryL2, JointSymmetryL2
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
