"""This room holds transforms for any TorchRL env: noise, delay, history, limits, units, statistics, mirrors, groups."""

from ksim_rl.transforms.clip import ActionClip, ObservationClip, RewardClip
from ksim_rl.transforms.command_curriculum import RandomCommandCurriculum
from ksim_rl.transforms.delay import ActionDelay, ObservationDelay
from ksim_rl.transforms.groups.compile_groups import compile_groups
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg
from ksim_rl.transforms.groups.group_spec import GroupSpec
from ksim_rl.transforms.groups.groups import ObservationGroups, group_specs, observation_columns
from ksim_rl.transforms.history import HistoryCfg, ObservationHistory
from ksim_rl.transforms.keyed_transform import KeyedTransform
from ksim_rl.transforms.lagged_transform import DelayCfg
from ksim_rl.transforms.level import FollowsLevel, follow_level
from ksim_rl.transforms.low_pass import ActionLowPass
from ksim_rl.transforms.mirror.mirror import Mirror, mirrored
from ksim_rl.transforms.mirror.mirror_map import (
    AXIAL,
    PLANAR_VELOCITY,
    POLAR,
    QUATERNION,
    MirrorMap,
)
from ksim_rl.transforms.mirror.robot_mirror import (
    mirror_by_name,
    mirror_group,
    mirror_joints,
    mirror_name,
)
from ksim_rl.transforms.noise.cfg import (
    ConstantNoise,
    GaussianNoise,
    NoiseCfg,
    UniformNoise,
)
from ksim_rl.transforms.noise.observation_noise import ObservationNoise
from ksim_rl.transforms.normalization import ObservationNormalization
from ksim_rl.transforms.scale import ActionScale, ObservationScale, RewardScale
from ksim_rl.transforms.time_aware import TimeAwareObservation
from ksim_rl.transforms.trackers import EpisodeTracker, SuccessTracker
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
