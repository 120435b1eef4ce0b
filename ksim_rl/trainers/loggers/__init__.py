"""Where metrics go. Any TorchRL logger fits: all that is called is `log_metrics` and `close`."""

from ksim_rl.trainers.loggers.csv_table import CsvTable
from ksim_rl.trainers.loggers.logger_cfg import LoggerCfg, make_loggers
from ksim_rl.trainers.loggers.metric_logger import MetricLogger

__all__ = ["CsvTable", "LoggerCfg", "MetricLogger", "make_loggers"]
