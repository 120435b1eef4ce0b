"""Transforms for any TorchRL env: noise, delay, history, limits, units, groups."""

from ksim_rl.envs.transforms.action_delay import ActionDelay
from ksim_rl.envs.transforms.clip import ObservationClip
from ksim_rl.envs.transforms.compile_groups import compile_groups
from ksim_rl.envs.transforms.delay import ObservationDelay
from ksim_rl.envs.transforms.delay_cfg import DelayCfg
from ksim_rl.envs.transforms.group_cfg import HistoryCfg, ObservationGroupCfg, ObservationTermCfg
from ksim_rl.envs.transforms.group_spec import GroupSpec
from ksim_rl.envs.transforms.groups import ObservationGroups
from ksim_rl.envs.transforms.history import ObservationHistory
from ksim_rl.envs.transforms.keyed_transform import KeyedTransform
from ksim_rl.envs.transforms.noise import ObservationNoise
from ksim_rl.envs.transforms.noise_cfg import ConstantNoise, GaussianNoise, NoiseCfg, UniformNoise
from ksim_rl.envs.transforms.scale import ObservationScale

__all__ = [
    "ActionDelay",
    "ConstantNoise",
    "DelayCfg",
    "GaussianNoise",
    "GroupSpec",
    "HistoryCfg",
    "KeyedTransform",
    "NoiseCfg",
    "ObservationClip",
    "ObservationDelay",
    "ObservationGroupCfg",
    "ObservationGroups",
    "ObservationHistory",
    "ObservationNoise",
    "ObservationScale",
    "ObservationTermCfg",
    "UniformNoise",
    "compile_groups",
]
