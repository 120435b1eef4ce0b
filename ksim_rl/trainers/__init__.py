"""The training loop, and what surrounds it: evaluation, checkpoints, logs, progress, pictures."""

from ksim_rl.trainers.build import build
from ksim_rl.trainers.checkpoint import Checkpoint, CheckpointError
from ksim_rl.trainers.evaluation import Evaluation, Evaluator
from ksim_rl.trainers.hook import Hook
from ksim_rl.trainers.off_policy_update import OffPolicyUpdate
from ksim_rl.trainers.ppo_update import PPOUpdate
from ksim_rl.trainers.progress import RunProgress
from ksim_rl.trainers.run_cfg import ModulesCfg, RunCfg
from ksim_rl.trainers.run_folder import Policy, load_policy, record_video, run
from ksim_rl.trainers.trainer import Outcome, Trainer
from ksim_rl.trainers.trainer_cfg import TrainerCfg

__all__ = [
    "Checkpoint",
    "CheckpointError",
    "Evaluation",
    "Evaluator",
    "Hook",
    "ModulesCfg",
    "OffPolicyUpdate",
    "Outcome",
    "PPOUpdate",
    "Policy",
    "RunCfg",
    "RunProgress",
    "Trainer",
    "TrainerCfg",
    "build",
    "load_policy",
    "record_video",
    "run",
]
