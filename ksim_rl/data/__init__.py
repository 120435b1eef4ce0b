"""TorchRL replay buffers for the env states that an RL update learns from."""

from ksim_rl.data.dataset_buffer import DatasetBuffer, DatasetCfg, rollout_length
from ksim_rl.data.dataset_storage import MASK_KEY, DatasetStorage, DatasetWriter
from ksim_rl.data.episode_folder import Leaf, Origin
from ksim_rl.data.episode_reader import Episodes, load, mend, read_episodes
from ksim_rl.data.episode_recorder import EpisodeRecorder, leaves_of
from ksim_rl.data.episode_writer import EpisodeWriter
from ksim_rl.data.epoch_sampler import BURN_IN_KEY, EpochSampler, SequenceSampler, sequence_length
from ksim_rl.data.lerobot import check_lerobot, write_lerobot
from ksim_rl.data.offline import OfflineCfg, OfflineTable, make_offline_table, offline_keys
from ksim_rl.data.recorder_cfg import RecorderCfg
from ksim_rl.data.replay_ring import PrioritySampler, ReplayCfg, ReplayRing, ReplaySampler
from ksim_rl.data.replay_storage import ReplayStorage, ReplayWriter
