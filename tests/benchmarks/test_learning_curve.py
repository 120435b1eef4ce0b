import functools
import json
import sys

import pytest

from benchmarks import learning_curve, report

WORDS = ("task=quadruped_velocity_flat", "device=cpu", "num_envs=4")
PREFIX = "cpu/quadruped_velocity_flat/4"


def curve(*rewards):
    return [
        {
            "env_states": 1e6 * i,
            "seconds": 10.0 * i,
            "episode/return": 5.0,
            "reward/upright": reward,
        }
        for i, reward in enumerate(rewards)
    ]


@pytest.fixture
def learn(monkeypatch, tmp_path):
    """Run `benchmarks.learning_curve` where each seed gives a curve, or an exit code; return what it wrote."""

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
        monkeypatch.setattr(
            sys, "argv", ["benchmark", *WORDS, f"seeds={','.join(map(str, outcomes))}"]
        )
        if ending is None:
            learning_curve.main()
        else:
            with pytest.raises(type(ending), match=str(ending)):
                learning_curve.main()
        return json.loads((tmp_path / "learning_quadruped_velocity_flat.json").read_text())

    return learn


LOW, MIDDLE, HIGH = curve(0.1, 0.2, 0.3), curve(0.1, 0.4, 0.6), curve(0.5, 0.7, 0.9)


def test_figures_are_medians_over_the_seeds_at_the_end_of_their_curves(learn):
    kept = learn({0: LOW, 1: HIGH, 2: MIDDLE}, None)
    assert kept["figures"][f"{PREFIX}/upright"] == 0.6
    assert kept["figures"][f"{PREFIX}/seconds"] == 20.0
    assert kept["curves"][f"{PREFIX}/seed_1"] == HIGH


def test_a_seed_that_fails_takes_the_medians_away_and_not_the_other_seeds(learn):
    kept = learn({1: LOW, 2: 1, 3: HIGH}, SystemExit("seeds 2 failed"))
    assert kept["figures"] == {}
    assert set(kept["curves"]) == {f"{PREFIX}/seed_1", f"{PREFIX}/seed_3"}


def test_what_was_done_before_a_run_is_cut_off_is_kept(learn):
    kept = learn({1: LOW, 2: KeyboardInterrupt("stopped")}, KeyboardInterrupt("stopped"))
    assert kept["curves"] == {f"{PREFIX}/seed_1": LOW}


def test_a_seed_given_as_an_override_is_refused_before_it_trains(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["benchmark", "task=cartpole_balance", "seed=3"])
    with pytest.raises(ValueError, match="seeds=3"):
        learning_curve.main()
