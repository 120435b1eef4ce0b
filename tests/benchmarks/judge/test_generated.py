"""Generated models are as in MuJoCo's C engine, in all that a view names: three, and over sixty in `make test-full`.

`python -m benchmarks.agreement --generated 400` judges more, and `--seed` other ones.
"""

from collections.abc import Sequence

import pytest
import warp as wp

from benchmarks.judge.generator import generate
from benchmarks.judge.hunt import MOST_SECONDS, Outcome, Task, figures, judged, told
from benchmarks.judge.workers import in_processes

# Each compiles kernels for the better part of ten seconds: those few run by our kernels, by our solver and by theirs.
SEED, FEW, MANY = 0, (0, 3, 15), 64
MORE = [number for number in range(MANY) if number not in FEW]
# Models that differ from C, each by something that is not mended yet.
KNOWN: dict[int, str] = {}


@pytest.fixture(scope="module")
def few() -> dict[int, Outcome]:
    """Judge models here, where most of their kernels are loaded already."""
    with pytest.MonkeyPatch.context() as patch:
        # What a judge sets for its process is taken back.
        patch.setattr(wp.config, "optimization_level", 0)
        return {number: judged(Task(seed=SEED, number=number)) for number in FEW}


@pytest.fixture(scope="module")
def more() -> dict[int, Outcome]:
    """Judge models in a child process: a model that crashes ends it, and the others go on in a new one."""
    tasks = [Task(seed=SEED, number=number) for number in MORE]
    found = {}
    for task, outcome in in_processes(judged, tasks, jobs=1, most_seconds=MOST_SECONDS):
        if isinstance(outcome, RuntimeError):
            outcome = Outcome(generated=generate(SEED, task.number), error=str(outcome))
        found[task.number] = outcome
    return found


def marked(numbers: Sequence[int]) -> list[object]:
    """Numbers of models, those that are known to differ marked so."""
    found: list[object] = []
    for number in numbers:
        marks = [pytest.mark.xfail(reason=KNOWN[number], strict=True)] if number in KNOWN else []
        found.append(pytest.param(number, marks=marks))
    return found


@pytest.mark.parametrize("number", marked(FEW))
def test_a_model_is_as_in_c(few: dict[int, Outcome], number: int):
    outcome = few[number]
    assert not outcome.fails, "\n".join(told(outcome))


def test_they_run_by_all_kernels_and_touch_each_other(few: dict[int, Outcome]):
    found = figures(list(few.values()))
    assert found["models"] == len(FEW)
    assert found["by_our_kernels"] >= 1
    assert found["by_our_solver"] >= 1
    assert found["touching_share"] >= 0.5
    assert found["states"] >= 20 * found["models"]


@pytest.mark.full
@pytest.mark.parametrize("number", marked(MORE))
def test_another_model_is_as_in_c(more: dict[int, Outcome], number: int):
    outcome = more[number]
    assert not outcome.fails, "\n".join(told(outcome))


@pytest.mark.full
def test_few_models_are_refused(few: dict[int, Outcome], more: dict[int, Outcome]):
    outcomes = [*few.values(), *more.values()]
    assert figures(outcomes)["refused_share"] <= 0.15
