"""Metrics go to loggers. Any of TorchRL's fits: all that is called is `log_metrics` and `close`."""

from ksim_rl.trainers.loggers.csv_table import CsvTable
from ksim_rl.trainers.loggers.logger_cfg import LoggerCfg, check_installed, make_loggers
from ksim_rl.trainers.loggers.metric_logger import MetricLogger
from ksim_rl.trainers.loggers.mlflow_logger import MLflowCfg
from ksim_rl.trainers.loggers.wandb_logger import WandbCfg

__all__ = [
    "CsvTable",
    "LoggerCfg",
    "MLflowCfg",
    "MetricLogger",
    "WandbCfg",
    "check_installed",
    "make_loggers",
]
