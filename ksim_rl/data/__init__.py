"""This room has TorchRL replay buffers for the env states that an RL update learns from."""

from ksim_rl.data.dataset_buffer import DatasetBuffer, DatasetCfg, rollout_length
from ksim_rl.data.dataset_storage import MASK_KEY, DatasetStorage, DatasetWriter
from ksim_rl.data.epoch_sampler import EpochSampler
from ksim_rl.data.replay_ring import ReplayCfg, ReplayRing
from ksim_rl.data.replay_samplers import PrioritySampler, ReplaySampler
from ksim_rl.data.replay_storage import ReplayStorage, ReplayWriter
from ksim_rl.data.sequence_sampler import BURN_IN_KEY, SequenceSampler, sequence_length

__all__ = [
    "BURN_IN_KEY",
    "MASK_KEY",
    "DatasetBuffer",
    "DatasetCfg",
    "DatasetStorage",
    "DatasetWriter",
    "EpochSampler",
    "PrioritySampler",
    "ReplayCfg",
    "ReplayRing",
    "ReplaySampler",
    "ReplayStorage",
    "ReplayWriter",
    "SequenceSampler",
    "rollout_length",
    "sequence_length",
]
