"""What no generated model has is as in MuJoCo's C engine, too."""

import pytest

from benchmarks.judge.hunt import MOST_SECONDS, told_of
from benchmarks.judge.trial import Verdict
from benchmarks.judge.workers import in_processes
from tests.benchmarks.judge.rare_models import MODELS, judged

# Models with states that are judged by the depths of contacts alone.
BY_DEPTHS = "cloths that touch themselves"
QUICK = [name for name in MODELS if name != BY_DEPTHS]


@pytest.fixture(scope="module")
def verdicts() -> dict[str, Verdict]:
    found = dict(in_processes(judged, QUICK, jobs=1, most_seconds=MOST_SECONDS))
    assert all(isinstance(verdict, Verdict) for verdict in found.values()), found
    return found


def check(verdict: Verdict) -> None:
    """Let nothing differ."""
    assert verdict.refused == ""
    assert verdict.states == 20
    assert not verdict.findings, "\n".join(told_of(verdict.findings))


# The models compile for the better part of a minute.
@pytest.mark.full
@pytest.mark.parametrize("name", QUICK)
def test_a_rare_model_is_as_in_c(verdicts: dict[str, Verdict], name: str):
    check(verdicts[name])


@pytest.mark.full
def test_triangles_of_a_cloth_touch_each_other_as_deep_as_in_c():
    (_, verdict), *_ = in_processes(judged, [BY_DEPTHS], jobs=1, most_seconds=MOST_SECONDS)
    check(verdict)
    assert 0 < verdict.accepted < verdict.states
