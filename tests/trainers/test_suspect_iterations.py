"""Where frozen Python is found late, the run names the iterations, and the last checkpoint before them is there."""

import pytest

from ksim_rl.collectors.recording import Recording
from ksim_rl.envs.recorded_python import FrozenPythonError
from ksim_rl.trainers.suspect_iterations import with_iterations
from tests.trainers.target_env import make_trainer


def test_a_run_ends_with_the_iterations_and_the_checkpoint_before_them(tmp_path, monkeypatch):
    folder = tmp_path / "checkpoint"
    trainer = make_trainer(folder, iterations=8, checkpoint_interval=1, keep_checkpoints=1)
    collect = trainer.collector.collect

    def collect_until_it_is_found():
        if trainer.iteration == 5:
            raise FrozenPythonError("rewards.x was frozen", rollouts=3)
        return collect()

    monkeypatch.setattr(trainer.collector, "collect", collect_until_it_is_found)
    # What was compared with the env's own step, the last time after the second rollout.
    unchecked = property(lambda recording: max(0, trainer.iteration - 2))
    monkeypatch.setattr(Recording, "unchecked_rollouts", unchecked)
    message = (
        r"rewards\.x was frozen\. These are the iterations 3 to 5; \S+/00000002 is from before them"
    )
    with pytest.raises(FrozenPythonError, match=message):
        trainer.train()
    assert sorted(path.name for path in folder.iterdir()) == ["00000002", "00000005"]


def test_without_a_checkpoint_from_before_that_is_said(tmp_path):
    error = FrozenPythonError("x", rollouts=1)
    assert "no checkpoint is from before" in str(
        with_iterations(error, iteration=1, folder=tmp_path)
    )
    assert (
        str(with_iterations(error, iteration=1, folder=None))
        == "x. These are the iterations 1 to 1"
    )


def test_an_error_about_what_comes_next_is_as_it_was():
    error = FrozenPythonError("x")
    assert with_iterations(error, iteration=5, folder=None) is error
