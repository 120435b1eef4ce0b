"""Generated models are as in MuJoCo's C engine, in all that a view names: twelve, and over fifty in `make test-full`.

`python -m benchmarks.agreement --generated 400` judges more, and `--seed` other ones.
"""

import pytest

from benchmarks.judge.generator import generate
from benchmarks.judge.hunt import MOST_SECONDS, Outcome, Task, figures, judged, told
from benchmarks.judge.workers import in_processes

# Of the first sixteen twelve run; the others are refused by name.
SEED, FEW, MANY = 0, 16, 64
# Models that differ from C, each by something that is not mended yet.
KNOWN: dict[int, str] = {}


def outcomes_of(wanted: range) -> dict[int, Outcome]:
    """Judge models in a process of its own, where kernels compile in less time."""
    tasks = [Task(seed=SEED, number=number) for number in wanted]
    found = {}
    for task, outcome in in_processes(judged, tasks, jobs=1, most_seconds=MOST_SECONDS):
        if isinstance(outcome, RuntimeError):
            # The process of a model that crashes ends, and the others go on.
            outcome = Outcome(generated=generate(SEED, task.number), error=str(outcome))
        found[task.number] = outcome
    return found


@pytest.fixture(scope="module")
def few() -> dict[int, Outcome]:
    return outcomes_of(range(FEW))


@pytest.fixture(scope="module")
def more() -> dict[int, Outcome]:
    return outcomes_of(range(FEW, MANY))


def numbers(start: int, stop: int) -> list[object]:
    """Numbers of models, those that are known to differ marked so."""
    found: list[object] = []
    for number in range(start, stop):
        marks = [pytest.mark.xfail(reason=KNOWN[number], strict=True)] if number in KNOWN else []
        found.append(pytest.param(number, marks=marks))
    return found


@pytest.mark.parametrize("number", numbers(0, FEW))
def test_a_model_is_as_in_c(few: dict[int, Outcome], number: int):
    outcome = few[number]
    assert not outcome.fails, "\n".join(told(outcome))


def test_most_models_run_by_our_kernels(few: dict[int, Outcome]):
    found = figures(list(few.values()))
    assert found["models"] >= 12
    assert found["by_our_kernels"] + found["by_our_solver"] >= 5
    assert found["touching_share"] >= 0.5
    assert found["states"] >= 20 * found["models"]


@pytest.mark.full
@pytest.mark.parametrize("number", numbers(FEW, MANY))
def test_another_model_is_as_in_c(more: dict[int, Outcome], number: int):
    outcome = more[number]
    assert not outcome.fails, "\n".join(told(outcome))


@pytest.mark.full
def test_few_models_are_refused(few: dict[int, Outcome], more: dict[int, Outcome]):
    outcomes = [*few.values(), *more.values()]
    assert figures(outcomes)["refused_share"] <= 0.15
