"""The loop: it learns, counts, logs, evaluates, saves, warns and stops."""

import errno
import os

import pytest
import torch

from ksim_rl.objectives import NonFiniteStepsError
from ksim_rl.trainers import RunProgress, checkpoint
from tests.trainers.target_env import BEST_RETURN, MemoryLogger, make_env, make_trainer


class Notes(RunProgress):
    """Remembers its notes."""

    def __init__(self):
        super().__init__(1, enabled=False)
        self.notes = []

    def note(self, text):
        self.notes.append(text)


def test_it_learns_a_problem_whose_best_return_is_known():
    trainer = make_trainer(iterations=60, eval_interval=10, solved_at=0.95 * BEST_RETURN)
    before = trainer.evaluator().return_mean
    outcome = trainer.train()
    assert before < 0.8 * BEST_RETURN
    assert outcome.solved
    assert 0.95 * BEST_RETURN <= outcome.evaluation.return_mean <= BEST_RETURN


def test_it_counts_env_states_and_ends_after_the_iterations():
    trainer = make_trainer(iterations=3)
    outcome = trainer.train()
    assert (outcome.iteration, outcome.env_states) == (3, 3 * 256)
    assert outcome.solved is None
    assert outcome.interrupted_by is None


def test_it_stops_when_solved_and_goes_on_when_told_so():
    anything_solves = {"iterations": 4, "eval_interval": 2, "solved_at": -1e9}
    assert make_trainer(**anything_solves).train().iteration == 2
    assert make_trainer(stop_when_solved=False, **anything_solves).train().iteration == 4


def test_each_logged_row_has_the_episode_loss_and_speed_metrics():
    logger = MemoryLogger()
    make_trainer(iterations=4, log_interval=2, loggers=[logger]).train()
    assert logger.closed
    rows = [row for row in logger.rows if "loss/policy" in row]
    assert [row["iteration"] for row in rows] == [2, 4]
    assert [row["step"] for row in rows] == [512, 1024]
    wanted = {
        "episode/return",
        "episode/length",
        "loss/value",
        "loss/entropy",
        "update/kl",
        "update/learning_rate",
    }
    assert wanted | {"throughput/env_states_per_s", "seconds", "rollout/reward"} <= set(rows[0])
    # Two rollouts of 16 steps are two episodes of 8 in each of 16 envs.
    assert rows[0]["episode/count"] == 32
    assert rows[0]["episode/length"] == 8
    # A term's figure is per second of the longest episode: 8 steps of 0.5 s.
    assert rows[0]["reward/hit"] == pytest.approx(rows[0]["episode/return"] / 4.0)


def test_the_final_policy_is_evaluated_once():
    logger = MemoryLogger()
    outcome = make_trainer(iterations=4, eval_interval=2, loggers=[logger]).train()
    evaluated = [row["step"] for row in logger.rows if "evaluation/return_mean" in row]
    assert evaluated == [512, 1024]
    assert outcome.evaluation.return_mean == logger.rows[-1]["evaluation/return_mean"]


def test_checkpoints_come_at_their_interval_and_at_the_end(tmp_path):
    make_trainer(tmp_path, iterations=5, checkpoint_interval=2, keep_checkpoints=5).train()
    assert [path.name for path in checkpoint.saved(tmp_path)] == ["00000002", "00000004", "00000005"]


def test_a_full_disk_costs_a_checkpoint_but_not_the_run(tmp_path, monkeypatch):
    trainer = make_trainer(tmp_path, iterations=4, checkpoint_interval=1)
    real, failing = os.fsync, {"on": False}

    def fsync(descriptor):
        if failing["on"]:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(descriptor)

    class FullAfterTwo(MemoryLogger):
        def log_metrics(self, metrics, step):
            failing["on"] = metrics["iteration"] == 3

    monkeypatch.setattr(os, "fsync", fsync)
    trainer.loggers, notes = [FullAfterTwo()], Notes()
    trainer.train(notes)
    assert [path.name for path in checkpoint.saved(tmp_path)] == ["00000001", "00000002", "00000004"]
    assert any("No space left on device" in note and "goes on" in note for note in notes.notes)
    assert not [entry for entry in tmp_path.iterdir() if entry.name.startswith(".")]


def test_steps_that_stay_non_finite_end_the_run_with_a_named_error():
    trainer = make_trainer(iterations=50, ppo={"max_skipped_steps": 40})
    weights = {name: value.clone() for name, value in trainer.update.actor.state_dict().items()}
    with torch.no_grad():
        next(trainer.update.critic.parameters()).fill_(float("nan"))
    with pytest.raises(NonFiniteStepsError, match="gradient steps in a row"):
        trainer.train()
    # 16 steps per iteration: the limit of 40 is reached in the third.
    assert trainer.iteration == 3
    after = trainer.update.actor.state_dict()
    learned = [name for name, _ in trainer.update.actor.named_parameters()]
    assert all(torch.equal(weights[name], after[name]) for name in learned)


class LossyWorld:
    """A world that lost contacts."""

    def overflow_report(self):
        class Report:
            metrics = {"nefc_share": 1.5}
            messages = (
                "constraint rows needed 30 per world but has 20: set sim.njmax >= 30 (NEFC in 4 worlds)",
            )

        return Report()


def test_lost_contacts_are_said_once_and_stay_in_the_metrics():
    env, logger, notes = make_env(), MemoryLogger(), Notes()
    env.base_env.__dict__["world"] = LossyWorld()
    make_trainer(iterations=3, env=env, loggers=[logger]).train(notes)
    said = [note for note in notes.notes if "njmax" in note]
    assert len(said) == 1
    assert "needed 30" in said[0]
    assert [row["physics/nefc_share"] for row in logger.rows if "physics/nefc_share" in row] == [1.5] * 3


class GuardedWorld(LossyWorld):
    """A world whose NaN guard saved something in the first rollout."""

    reports = 0

    def nan_report(self):
        self.reports += 1

        class Report:
            messages = ("world 3 became non-finite: see nan-0.safetensors",) if self.reports == 1 else ()

        return Report()


def test_what_the_nan_guard_saved_is_said_where_it_happened():
    env, notes = make_env(), Notes()
    env.base_env.__dict__["world"] = world = GuardedWorld()
    make_trainer(iterations=2, env=env).train(notes)
    assert world.reports == 2, "once per rollout"
    assert [note for note in notes.notes if "nan-0.safetensors" in note] == [
        "NaN guard: world 3 became non-finite: see nan-0.safetensors"
    ]


def test_envs_that_became_non_finite_are_reported():
    env, notes = make_env(), Notes()
    env.base_env.totals["termination/non_finite"].fill_(2.0)
    make_trainer(iterations=1, env=env).train(notes)
    assert any("2 envs ended with non-finite" in note for note in notes.notes)
