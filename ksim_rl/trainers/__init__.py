"""The training loop, with evaluation, checkpoints, logs, progress and pictures."""

import importlib
from typing import Any

from ksim_rl.trainers.algorithm import Algorithm, Update
from ksim_rl.trainers.build import build
from ksim_rl.trainers.checkpoint import Checkpoint, CheckpointError
from ksim_rl.trainers.evaluation import Evaluation, Evaluator
from ksim_rl.trainers.outcome import Outcome
from ksim_rl.trainers.progress import RunProgress
from ksim_rl.trainers.run_cfg import ModulesCfg, RunCfg, TrainerCfg, TrainingCfg
from ksim_rl.trainers.run_folder import Policy, load_policy, record_video, run
from ksim_rl.trainers.trainer import Hook, Trainer


def __getattr__(name: str) -> Any:
    """Find the updates, which users import from here as well, in the room above."""
    algorithms = importlib.import_module("ksim_rl.algorithms")
    if name.endswith("Update") and name in algorithms.__all__:
        return getattr(algorithms, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
