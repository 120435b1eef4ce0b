import functools
import json
import sys

import pytest

from benchmarks import learning_curve, learning_time, report
from benchmarks.learning_time import LEVELS

WORDS = ("task=quadruped_velocity_flat", "device=cpu", "num_envs=4")
PREFIX = "cpu/quadruped_velocity_flat/4"
GOOD, BAD = (1.5, 1.3), (1.5, 0.9)


def curve(*pairs):
    names = list(LEVELS)
    return [
        {
            "env_states": 1e6 * i,
            "seconds": 10.0 * i,
            "episode/return": 5.0,
            names[0]: linear,
            names[1]: angular,
        }
        for i, (linear, angular) in enumerate(pairs)
    ]


@pytest.fixture
def learn(monkeypatch, tmp_path):
    """Run `benchmarks.learning_time` where each seed gives a curve, or an exit code; return what it wrote."""

    def learn(outcomes, ending):
        class Process:
            def __init__(self, words, seed, points, gpu):
                self.outcome, self.points, self.returncode = outcomes[seed], points, 0

            def wait(self):
                if isinstance(self.outcome, BaseException):
                    raise self.outcome
                if isinstance(self.outcome, int):
                    self.returncode = self.outcome
                else:
                    self.points.write_text(json.dumps(self.outcome))
                return self.returncode

        monkeypatch.setattr(learning_curve, "_start", Process)
        monkeypatch.setattr(report, "write", functools.partial(report.write, folder=tmp_path))
        monkeypatch.setattr(sys, "argv", ["benchmark", *WORDS, f"seeds={','.join(map(str, outcomes))}"])
        if ending is None:
            learning_time.main()
        else:
            with pytest.raises(type(ending), match=str(ending)):
                learning_time.main()
        files = ("learning_time", "learning_quadruped_velocity_flat")
        paths = [tmp_path / f"{name}.json" for name in files]
        return [json.loads(path.read_text()) if path.exists() else {} for path in paths]

    return learn


FAST, SLOW, NEVER = curve(GOOD, GOOD, GOOD), curve(BAD, BAD, GOOD, GOOD, GOOD), curve(BAD, BAD, BAD)


def test_the_median_is_that_of_the_seeds_and_stands_under_its_device(learn):
    times, curves = learn({0: FAST, 1: SLOW, 2: NEVER}, None)
    assert times["figures"] == {f"{PREFIX}/seconds_to_track": 30.0, f"{PREFIX}/env_states_to_track": 3e6}
    assert list(times["seconds_of_seeds"].values()) == [10.0, 30.0, None]
    assert f"{PREFIX}/track_linear_velocity" in curves["figures"]
    assert curves["curves"][f"{PREFIX}/seed_1"] == SLOW


def test_where_most_seeds_do_not_get_there_it_is_written_which_did(learn):
    times, curves = learn({1: NEVER, 2: FAST, 3: NEVER}, SystemExit("most seeds did not get there"))
    assert times["figures"] == {}
    assert times["seconds_of_seeds"] == {
        f"{PREFIX}/seed_1": None,
        f"{PREFIX}/seed_2": 10.0,
        f"{PREFIX}/seed_3": None,
    }
    assert len(curves["curves"]) == 3


def test_a_seed_that_fails_takes_the_medians_away_and_not_the_other_seeds(learn):
    times, curves = learn({1: FAST, 2: 1, 3: FAST}, SystemExit("seeds 2 failed"))
    assert times["figures"] == curves["figures"] == {}
    assert set(times["seconds_of_seeds"]) == set(curves["curves"]) == {f"{PREFIX}/seed_1", f"{PREFIX}/seed_3"}


def test_what_was_done_before_a_run_is_cut_off_is_kept(learn):
    times, curves = learn({1: FAST, 2: KeyboardInterrupt("stopped")}, KeyboardInterrupt("stopped"))
    assert times == {}
    assert curves["curves"] == {f"{PREFIX}/seed_1": FAST}


def test_a_task_without_the_rewards_is_refused_before_it_trains(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["benchmark", "task=cartpole_balance", "device=cpu"])
    with pytest.raises(ValueError, match="choose a velocity task"):
        learning_time.main()
    monkeypatch.setattr(sys, "argv", ["benchmark", "task=cartpole_balance", "seed=3"])
    with pytest.raises(ValueError, match="seeds=3"):
        learning_time.main()
