"""The pages about runs and about changing tasks: their examples run as they stand."""

import re

import pytest

from ksim_rl.runs import record
from tests.docs.guide import DOCS


def examples(page):
    return dict(
        re.findall(
            r"<!-- example: (\w+) -->\n```python\n(.*?)```", (DOCS / page).read_text(), re.DOTALL
        )
    )


def execute(page, name):
    scope = {"__name__": name}
    exec(compile(examples(page)[name], f"docs/{page}: {name}", "exec"), scope)  # noqa: S102
    return scope


@pytest.fixture(autouse=True)
def work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.full
def test_a_run_is_made_and_read_from_python(work):
    scope = execute("runs.md", "python")
    assert record.status(work / "runs" / "mine") == ("done", "all 2 iterations are done")
    assert tuple(scope["rollout_ET"].shape) == (4, 50)


@pytest.mark.full
def test_optuna_searches(work):
    pytest.importorskip("optuna")
    assert "learning_rate" in execute("runs.md", "optuna")["study"].best_params


def test_a_task_is_changed_by_overrides_and_by_replace():
    assert "slow" in execute("existing_task.md", "overrides")["env"].base_env.cfg.rewards
    assert "slow" in execute("existing_task.md", "replace")["env"].base_env.cfg.rewards


def test_a_model_alone_is_a_robot():
    scope = execute("existing_task.md", "mjcf")
    assert tuple(scope["env"].rollout(3)["actor"].shape) == (4, 3, 1)
