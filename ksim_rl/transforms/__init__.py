"""This room holds transforms for any TorchRL env: noise, delay, history, limits, units, statistics, mirrors, groups."""

from ksim_rl.transforms.clip import ActionClip, ObservationClip, RewardClip
from ksim_rl.transforms.command_curriculum import RandomCommandCurriculum
from ksim_rl.transforms.delay import ActionDelay, DelayCfg, ObservationDelay
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg, compile_groups
from ksim_rl.transforms.groups.groups import GroupSpec, ObservationGroups, group_specs, observation_columns
from ksim_rl.transforms.history import HistoryCfg, ObservationHistory
from ksim_rl.transforms.low_pass import ActionLowPass
from ksim_rl.transforms.mirror.mirror import (
    AXIAL,
    PLANAR_VELOCITY,
    POLAR,
    QUATERNION,
    Mirror,
    MirrorMap,
    mirrored,
)
from ksim_rl.transforms.mirror.robot_mirror import mirror_by_name, mirror_group, mirror_joints, mirror_name
from ksim_rl.transforms.noise.cfg import ConstantNoise, GaussianNoise, NoiseCfg, UniformNoise
from ksim_rl.transforms.noise.observation_noise import ObservationNoise
from ksim_rl.transforms.normalization import ObservationNormalization
from ksim_rl.transforms.row_transform import FollowsLevel, KeyedTransform, follow_level
from ksim_rl.transforms.scale import ActionScale, ObservationScale, RewardScale
from ksim_rl.transforms.trackers import EpisodeTracker, SuccessTracker, TimeAwareObservation
from ksim_rl.transforms.transform_cfg import TransformCfg

__all__ = [
    "AXIAL",
    "ActionClip",
    "ActionDelay",
    "ActionLowPass",
    "ActionScale",
    "ConstantNoise",
    "DelayCfg",
    "EpisodeTracker",
    "FollowsLevel",
    "GaussianNoise",
    "GroupSpec",
    "HistoryCfg",
    "KeyedTransform",
    "Mirror",
    "MirrorMap",
    "NoiseCfg",
    "ObservationClip",
    "ObservationDelay",
    "ObservationGroupCfg",
    "ObservationGroups",
    "ObservationHistory",
    "ObservationNoise",
    "ObservationNormalization",
    "ObservationScale",
    "ObservationTermCfg",
    "PLANAR_VELOCITY",
    "POLAR",
    "QUATERNION",
    "RandomCommandCurriculum",
    "RewardClip",
    "RewardScale",
    "SuccessTracker",
    "TimeAwareObservation",
    "TransformCfg",
    "UniformNoise",
    "compile_groups",
    "follow_level",
    "group_specs",
    "mirror_by_name",
    "mirror_group",
    "mirror_joints",
    "mirror_name",
    "mirrored",
    "observation_columns",
]
