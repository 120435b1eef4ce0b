"""What a run's loggers leave in its folder."""

import importlib.util
import json
import struct
import time

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torchrl.record.loggers import CSVLogger

from ksim_rl.trainers import loggers
from ksim_rl.trainers.loggers import LoggerCfg, MLflowCfg, WandbCfg, check_installed, make_loggers
from tests.trainers.target_env import make_trainer

CONFIG = {"task_name": "probe", "objective": {"gamma": 0.99, "betas": [0.9, 0.999]}}


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


@pytest.mark.parametrize(("name", "cfg"), [("wandb", WandbCfg()), ("mlflow", MLflowCfg())])
def test_a_logger_without_its_package_says_how_to_install_it(monkeypatch, name, cfg):
    real = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda wanted: None if wanted == name else real(wanted)
    )
    check_installed(LoggerCfg())
    with pytest.raises(ValueError, match=rf"logger.{name}: .* pip install 'ksim_rl\[{name}\]'"):
        check_installed(LoggerCfg(**{name: cfg}))


def log_two_sessions(cfg, folder):
    """Log as a run does that is resumed once: two rows, then one more after it was opened again."""
    for rows in ([(512, 0.25), (1024, 0.125)], [(1536, 0.5)]):
        (logger,) = make_loggers(cfg, folder, config=CONFIG)
        for step, value in rows:
            logger.log_metrics({"loss/policy": value, "iteration": step / 512}, step)
        logger.log_metrics({"evaluation/return_mean": 7.0}, rows[-1][0])
        logger.close()
        time.sleep(1.1)  # wandb names a session after the second it began in


def test_mlflow_has_figures_and_config_of_a_run_that_was_resumed(tmp_path, monkeypatch):
    pytest.importorskip("mlflow")
    from mlflow.tracking import MlflowClient

    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    folder = tmp_path / "2030-01-01"
    log_two_sessions(
        LoggerCfg(csv=False, tensorboard=False, mlflow=MLflowCfg(experiment="probe")), folder
    )
    client = MlflowClient(f"sqlite:///{folder / 'mlflow' / 'mlflow.db'}")
    experiment = client.get_experiment_by_name("probe")
    (found,) = client.search_runs([experiment.experiment_id])
    assert found.info.run_name == "2030-01-01" and found.info.status == "FINISHED"
    assert found.data.params == {
        "task_name": "probe",
        "objective.gamma": "0.99",
        "objective.betas": "[0.9, 0.999]",
    }
    points = client.get_metric_history(found.info.run_id, "loss/policy")
    assert sorted((p.step, p.value) for p in points) == [(512, 0.25), (1024, 0.125), (1536, 0.5)]
    assert found.data.metrics["evaluation/return_mean"] == 7.0


def wandb_records(folder):
    """Read what wandb wrote to disk: protobuf messages in the log format of LevelDB, after 7 bytes of its own."""
    from wandb.proto import wandb_internal_pb2

    for path in sorted(folder.glob("wandb/offline-run-*/*.wandb")):
        content, at, message = path.read_bytes(), 7, b""
        while at < len(content):
            if -at % 32768 < 7:  # a block's last bytes hold no header
                at += -at % 32768
            length, kind = struct.unpack("<HB", content[at + 4 : at + 7])
            message += content[at + 7 : at + 7 + length]
            at += 7 + length
            if kind in (1, 4):  # a whole message, or the last part of one
                record = wandb_internal_pb2.Record()
                record.ParseFromString(message)
                message = b""
                yield record


def test_wandb_offline_has_figures_and_config_of_a_run_that_was_resumed(tmp_path):
    pytest.importorskip("wandb")
    folder = tmp_path / "2030-01-01"
    cfg = WandbCfg(project="probe", offline=True, tags=("test",))
    log_two_sessions(LoggerCfg(csv=False, tensorboard=False, wandb=cfg), folder)
    records = list(wandb_records(folder))
    runs = [record.run for record in records if record.WhichOneof("record_type") == "run"]
    assert {run.run_id for run in runs} == {(folder / "wandb" / "run_id").read_text()}
    assert (
        runs[0].project == "probe"
        and runs[0].display_name == "2030-01-01"
        and "test" in runs[0].tags
    )
    rows = [
        {item.key or "/".join(item.nested_key): item.value_json for item in record.history.item}
        for record in records
        if record.WhichOneof("record_type") == "history"
    ]
    values = [(row["loss/step"], row["loss/policy"]) for row in rows if "loss/policy" in row]
    assert values == [("512", "0.25"), ("1024", "0.125"), ("1536", "0.5")]
    assert [row["evaluation/return_mean"] for row in rows if "evaluation/return_mean" in row] == [
        "7"
    ] * 2
    configs = [record.run.config for record in records if record.WhichOneof("record_type") == "run"]
    configs += [record.config for record in records if record.WhichOneof("record_type") == "config"]
    updates = {update.key: update.value_json for config in configs for update in config.update}
    assert json.loads(updates["objective"]) == CONFIG["objective"]


def test_a_service_that_is_not_there_is_named_with_the_way_out(monkeypatch, tmp_path):
    def refuse(*_):
        raise Exception("no such host")

    monkeypatch.setattr(loggers, "open_wandb", refuse)
    with pytest.raises(
        RuntimeError, match=r"logger\.wandb .*logger\.wandb\.offline=true.*no such host"
    ):
        make_loggers(LoggerCfg(wandb=WandbCfg()), tmp_path)
