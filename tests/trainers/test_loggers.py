"""What a run's loggers leave in its folder."""

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torchrl.record.loggers import CSVLogger

from ksim_rl.trainers.loggers import LoggerCfg, make_loggers
from tests.trainers.target_env import make_trainer


def test_csv_and_tensorboard_hold_the_same_figures(tmp_path):
    for logger in make_loggers(LoggerCfg(), tmp_path):
        logger.log_metrics({"loss/policy": 0.25}, 512)
        logger.close()
    assert (tmp_path / "metrics.csv").read_text() == "env_states,loss/policy\n512,0.25\n"
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [(event.step, event.value) for event in events.Scalars("loss/policy")] == [(512, 0.25)]


def test_loggers_can_be_off(tmp_path):
    assert make_loggers(LoggerCfg(csv=False, tensorboard=False), tmp_path) == []
    assert list(tmp_path.iterdir()) == []


def test_a_torchrl_logger_works_as_it_is(tmp_path):
    make_trainer(iterations=1, loggers=[CSVLogger("run", log_dir=str(tmp_path))]).train()
    assert (tmp_path / "run" / "scalars" / "loss" / "policy.csv").exists() or list(
        tmp_path.rglob("*policy.csv")
    )
