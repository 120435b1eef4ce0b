"""SIGINT and SIGTERM: the iteration is finished, everything is saved, the exit code tells."""

import os
import signal
import threading

import pytest

from ksim_rl.trainers import checkpoint
from ksim_rl.trainers.interrupt import InterruptRequest
from tests.trainers.target_env import MemoryLogger, make_trainer


class SendSignal(MemoryLogger):
    """Sends a signal to this process when an iteration is logged."""

    def __init__(self, number, iteration):
        super().__init__()
        self.number, self.iteration = number, iteration

    def log_metrics(self, metrics, step):
        if metrics["iteration"] == self.iteration:
            os.kill(os.getpid(), self.number)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_run_after_the_iteration_with_everything_saved(tmp_path, number):
    trainer = make_trainer(tmp_path, iterations=50, loggers=[SendSignal(number, 3)])
    outcome = trainer.train()
    assert outcome.interrupted_by == number
    assert outcome.iteration == 3
    assert checkpoint.load_latest(tmp_path).iteration == 3


def test_a_request_is_true_once_its_signal_came():
    with InterruptRequest() as request:
        assert not request and request.signal is None
        os.kill(os.getpid(), signal.SIGTERM)
        assert request and request.signal == signal.SIGTERM


def test_a_second_signal_interrupts_at_once():
    with pytest.raises(KeyboardInterrupt), InterruptRequest():
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)


def test_handlers_are_given_back():
    before = signal.getsignal(signal.SIGINT)
    with InterruptRequest():
        assert signal.getsignal(signal.SIGINT) is not before
    assert signal.getsignal(signal.SIGINT) is before


def test_outside_the_main_thread_nothing_is_installed():
    before, seen = signal.getsignal(signal.SIGINT), []

    def work():
        with InterruptRequest():
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [before]
