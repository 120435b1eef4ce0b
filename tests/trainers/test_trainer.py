"""The loop: it learns, counts, logs, evaluates, saves, warns and stops."""

import errno
import os

import pytest
import torch

from ksim_rl.envs.contract import SimulatedWorld
from ksim_rl.objectives import NonFiniteStepsError
from ksim_rl.testing import count_syncs
from ksim_rl.trainers import Hook, RunProgress, checkpoint
from tests.trainers.target_env import BEST_RETURN, MemoryLogger, TargetEnv, make_env, make_trainer


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
    assert [path.name for path in checkpoint.saved(tmp_path)] == [
        "00000002",
        "00000004",
        "00000005",
    ]


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
    assert [path.name for path in checkpoint.saved(tmp_path)] == [
        "00000001",
        "00000002",
        "00000004",
    ]
    assert any("No space left on device" in note and "goes on" in note for note in notes.notes)
    assert not [entry for entry in tmp_path.iterdir() if entry.name.startswith(".")]


def test_a_checkpoint_of_the_end_that_cannot_be_written_is_an_error_that_says_so(
    tmp_path, monkeypatch
):
    trainer = make_trainer(tmp_path, iterations=2, checkpoint_interval=1)

    def fsync(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(
        OSError, match="no checkpoint of the end, iteration 2: .*No space left on device"
    ):
        trainer.train(Notes())


def test_a_logger_that_fails_costs_its_rows_but_not_the_run(tmp_path):
    class Gone(MemoryLogger):
        def log_metrics(self, metrics, step):
            raise ConnectionError("no answer")

        def close(self):
            raise ConnectionError("no answer")

    trainer, notes = make_trainer(tmp_path, iterations=3), Notes()
    trainer.loggers = [Gone(), MemoryLogger()]
    assert trainer.train(notes).iteration == 3
    assert [row["iteration"] for row in trainer.loggers[1].rows] == [1, 2, 3, 3], (
        "the last with its evaluation"
    )
    said = [note for note in notes.notes if "the logger Gone failed at iteration 1" in note]
    others = [note for note in notes.notes if not note.startswith("TargetEnv has no ")]
    assert said == others and len(said) == 1 and "ConnectionError: no answer" in said[0]


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
    """A world that needs 30 rows of 20, in as many worlds as it counts on the device."""

    can_be_recorded = False

    def overflow_counts(self):
        return torch.tensor([4, 30])

    def explain_overflow(self, numbers):
        worlds, rows = numbers

        class Report:
            metrics = {"nefc_share": rows / 20}
            lost_worlds = worlds
            messages = (
                f"constraint rows needed {rows} per world but has 20: set sim.njmax >= {rows} "
                f"(NEFC in {worlds} worlds)",
            )

        return Report()

    def nan_count(self):
        return torch.tensor(0)


class SimulatedTargetEnv(TargetEnv):
    """With the physics, or what reports instead of it, that a test gives it."""


SimulatedWorld.register(SimulatedTargetEnv)


def test_lost_contacts_are_said_once_and_stay_in_the_metrics():
    env, logger, notes = make_env(kind=SimulatedTargetEnv), MemoryLogger(), Notes()
    env.base_env.__dict__["world"] = LossyWorld()
    make_trainer(iterations=3, env=env, loggers=[logger]).train(notes)
    said = [note for note in notes.notes if "njmax" in note]
    assert len(said) == 1
    assert "needed 30" in said[0] and "4 worlds" in said[0]
    assert [row["physics/nefc_share"] for row in logger.rows if "physics/nefc_share" in row] == [
        1.5
    ] * 3


def test_contacts_that_an_evaluation_lost_are_said():
    trainer, notes = make_trainer(iterations=2, eval_interval=2), Notes()
    judging = make_env(10, kind=SimulatedTargetEnv)
    judging.base_env.__dict__["world"] = LossyWorld()
    trainer.evaluator.env = judging
    trainer.train(notes)
    assert [note.split(":")[:2] for note in notes.notes if "njmax" in note] == [
        ["warning", " evaluation at iteration 2"]
    ]
    # And counted, for tables of results.
    assert trainer.evaluation.lost_worlds == 4


class GuardedWorld(LossyWorld):
    """A world whose NaN guard has something to save after the first rollout."""

    counts = reports = 0

    def nan_count(self):
        self.counts += 1
        return torch.tensor(int(self.counts == 1))

    def nan_report(self):
        self.reports += 1

        class Report:
            messages = ("world 3 became non-finite: see nan-0.safetensors",)

        return Report()


def test_what_the_nan_guard_saved_is_said_where_it_happened():
    env, notes = make_env(kind=SimulatedTargetEnv), Notes()
    env.base_env.__dict__["world"] = world = GuardedWorld()
    make_trainer(iterations=3, env=env).train(notes)
    assert (world.counts, world.reports) == (3, 1), "only what the count says is there is read"
    assert [note for note in notes.notes if "nan-0.safetensors" in note] == [
        "NaN guard: world 3 became non-finite: see nan-0.safetensors"
    ]


def test_envs_that_became_non_finite_are_reported():
    env, notes = make_env(), Notes()
    env.base_env.totals["termination/non_finite"].fill_(2.0)
    make_trainer(iterations=1, env=env).train(notes)
    assert any("2 envs ended with non-finite" in note for note in notes.notes)


class Diary(Hook):
    """Writes down when it was called, and what the trainer said then."""

    def __init__(self, interval=1):
        self.interval, self.calls, self.ended = interval, [], 0

    def __call__(self, trainer):
        self.calls.append((trainer.iteration, trainer.metrics["iteration"]))

    def at_end(self, trainer):
        self.ended += 1

    def state_dict(self):
        return {"calls": len(self.calls), "last": torch.tensor(self.calls[-1])}

    def load_state_dict(self, state):
        self.calls = [tuple(state["last"].tolist())] * state["calls"]


@pytest.mark.parametrize("overlap", [False, True])
def test_a_hook_sees_the_metrics_of_its_iteration(overlap):
    hook = Diary(interval=2)
    make_trainer(iterations=5, hooks=[hook], overlap=overlap).train()
    assert hook.calls == [(2, 2), (4, 4)]
    assert hook.ended == 1


def test_a_hook_continues_from_a_checkpoint(tmp_path):
    make_trainer(tmp_path, iterations=3, hooks=[Diary()]).train()
    hook = Diary()
    resumed = make_trainer(iterations=4, hooks=[hook])
    resumed.load(tmp_path)
    resumed.train()
    assert hook.calls == [(3, 3)] * 3 + [(4, 4)]
    with pytest.raises(ValueError, match="1 hooks that keep something, and this one has 0"):
        make_trainer().load(tmp_path)


def test_hooks_that_keep_nothing_come_and_go(tmp_path):
    """As a viewer does, which `ksim-rl resume RUN viewer.browser=true` opens on a run that had none."""
    make_trainer(tmp_path, iterations=2, hooks=[Diary()]).train()
    hook = Diary()
    resumed = make_trainer(tmp_path, iterations=3, hooks=[Hook(), hook])
    resumed.load(tmp_path)
    resumed.train()
    assert hook.calls == [(2, 2)] * 2 + [(3, 3)]
    hook = Diary()
    resumed = make_trainer(iterations=4, hooks=[hook])
    resumed.load(tmp_path)
    resumed.train()
    assert hook.calls[-1] == (4, 4) and len(hook.calls) == 4


def test_what_a_hook_changes_counts_in_the_next_iteration():
    class Stop(Hook):
        def __call__(self, trainer):
            for group in trainer.update.optimizer.param_groups:
                group["lr"].zero_()

    trainer = make_trainer(iterations=1, hooks=[Stop()], ppo={"schedule": "fixed"})
    trainer.train()
    weights = {name: p.detach().clone() for name, p in trainer.update.actor.named_parameters()}
    trainer.iterate()
    assert all(torch.equal(weights[name], p) for name, p in trainer.update.actor.named_parameters())


def rows_without_times(trainer_rows):
    timed = ("seconds", "throughput/env_states_per_s", "warm_up_s")
    return [
        {name: value for name, value in row.items() if name not in timed} for row in trainer_rows
    ]


def test_overlapping_iterations_log_the_same_rows():
    one, other = MemoryLogger(), MemoryLogger()
    make_trainer(iterations=5, eval_interval=2, loggers=[one], overlap=False).train()
    make_trainer(iterations=5, eval_interval=2, loggers=[other], overlap=True).train()
    assert len(one.rows) == 5 + 3
    assert rows_without_times(one.rows) == rows_without_times(other.rows)


def test_a_target_ends_the_run_one_iteration_later_where_iterations_overlap():
    trainer = make_trainer(iterations=20, stop_at={"iteration": 4, "episode/length": 8})
    outcome = trainer.train()
    assert (outcome.iteration, outcome.target_met) == (4, True)
    assert (
        make_trainer(iterations=20, stop_at={"iteration": 4}, overlap=True).train().iteration == 5
    )
    # An evaluation settles its iteration, so nothing is late then.
    assert (
        make_trainer(iterations=20, stop_at={"iteration": 4}, overlap=True, eval_interval=4)
        .train()
        .iteration
        == 4
    )


def test_targets_count_only_together_and_evaluations_too():
    figures = {"evaluation/return_mean": -1e9, "iteration": 3}
    outcome = make_trainer(iterations=6, eval_interval=2, stop_at=figures).train()
    assert outcome.iteration == 4
    missed = make_trainer(iterations=2, stop_at={"iteration": 1, "episode/return": 1e9}).train()
    assert (missed.iteration, missed.target_met) == (2, False)


def test_a_target_that_no_metric_has_is_said():
    notes = Notes()
    make_trainer(iterations=2, stop_at={"episode/retrun": 1.0}).train(notes)
    (text,) = [note for note in notes.notes if "stop_at" in note]
    assert "did you mean 'episode/return'" in text


def test_an_iteration_reads_the_device_once():
    trainer = make_trainer()
    trainer.iterate()
    with count_syncs() as syncs:
        trainer.iterate()
    assert syncs.total == 1, syncs.report()
    assert "metrics.py" in syncs.calls[0]
