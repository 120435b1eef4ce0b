"""The table of robots that nobody prepared has a row for each line of its tasks."""

import runpy
from pathlib import Path

from ksim_rl.envs import Task
from ksim_rl.tables.table import load

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_each_robot_has_a_row_with_the_figures_that_readers_ask_for():
    named = runpy.run_path(str(EXAMPLES / "unseen_robots.py")).values()
    tasks = [value.name for value in named if isinstance(value, Task)]
    table = load(str(EXAMPLES / "unseen_robots.yaml"))
    assert table.name == "robots", "figures are called robots/<row>/seconds and /falls"
    rows = {f"{name}_velocity_flat": row.task for name, row in table.rows.items()}
    assert len(tasks) == 9 and rows == {name: name for name in tasks}
