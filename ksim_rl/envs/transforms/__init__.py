from ksim_rl.envs.transforms.group_spec import GroupSpec
from ksim_rl.envs.transforms.groups import ObservationGroups
from ksim_rl.envs.transforms.keyed_transform import KeyedTransform
from ksim_rl.envs.transforms.noise import ObservationNoise
from ksim_rl.envs.transforms.noise_cfg import ConstantNoise, GaussianNoise, NoiseCfg, UniformNoise

__all__ = [
    "ConstantNoise",
    "GaussianNoise",
    "GroupSpec",
    "KeyedTransform",
    "NoiseCfg",
    "ObservationGroups",
    "ObservationNoise",
    "UniformNoise",
]
