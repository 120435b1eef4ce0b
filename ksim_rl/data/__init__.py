"""Datasets and samplers: TorchRL replay buffers for the env states of one RL update."""

from ksim_rl.data.dataset_buffer import DatasetBuffer
from ksim_rl.data.dataset_cfg import DatasetCfg, rollout_length
from ksim_rl.data.dataset_storage import MASK_KEY, DatasetStorage, DatasetWriter
from ksim_rl.data.epoch_sampler import EpochSampler

__all__ = [
    "MASK_KEY",
    "DatasetBuffer",
    "DatasetCfg",
    "DatasetStorage",
    "DatasetWriter",
    "EpochSampler",
    "rollout_length",
]
