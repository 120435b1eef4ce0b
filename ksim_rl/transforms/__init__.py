"""Transforms for any TorchRL env: noise, delay, history, limits, units, statistics, mirrors, groups.

A transform is public once it is imported here.
"""

import inspect

from ksim_rl.transforms.delay import ActionDelay, DelayCfg, ObservationDelay
from ksim_rl.transforms.elementwise import (
    ActionClip,
    ActionScale,
    ObservationClip,
    ObservationScale,
    RewardClip,
    RewardScale,
)
from ksim_rl.transforms.groups.group_cfg import (
    ObservationGroupCfg,
    ObservationTermCfg,
    compile_groups,
)
from ksim_rl.transforms.groups.groups import (
    GroupSpec,
    ObservationGroups,
    group_specs,
    observation_columns,
)
from ksim_rl.transforms.history import HistoryCfg, ObservationHistory, stacked_frames
from ksim_rl.transforms.hold import ObservationHold
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
from ksim_rl.transforms.mirror.robot_mirror import (
    mirror_by_name,
    mirror_group,
    mirror_joints,
    mirror_name,
)
from ksim_rl.transforms.noise.cfg import ConstantNoise, GaussianNoise, NoiseCfg, UniformNoise
from ksim_rl.transforms.noise.observation_noise import ObservationNoise
from ksim_rl.transforms.normalization import ObservationNormalization
from ksim_rl.transforms.pictures.effects import (
    Blur,
    Brightness,
    Contrast,
    CutOut,
    DepthHoles,
    DepthRange,
    DepthSteps,
    PictureEffect,
    PixelNoise,
    RandomCrop,
    RandomShift,
)
from ksim_rl.transforms.pictures.picture_effects import PictureEffects
from ksim_rl.transforms.row_transform import FollowsLevel, KeyedTransform, follow_level
from ksim_rl.transforms.trackers import EpisodeTracker, SuccessTracker, TimeAwareObservation
from ksim_rl.transforms.transform_cfg import TransformCfg

__all__ = sorted(
    name for name, value in globals().items() if name[0] != "_" and not inspect.ismodule(value)
)  # pyright: ignore
