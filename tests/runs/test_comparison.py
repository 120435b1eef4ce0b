"""Runs side by side: figures, what differs in their configs, and a picture."""

import imageio.v2 as imageio
import pytest

from ksim_rl.runs import comparison
from tests.runs.test_listing import make_run


@pytest.fixture
def pair(tmp_path):
    return [
        make_run(tmp_path / "first" / "run", seed=1, returns=(1.0, 5.0, 3.0)),
        make_run(tmp_path / "second" / "run", seed=2, returns=(2.0, 4.0), evaluation=9.0),
    ]


def test_the_table_has_a_column_per_run_and_a_row_for_each_field_that_differs(pair):
    rows = {head: cells for head, *cells in comparison.figures(pair)}
    assert rows["run"] == ["first/run", "second/run"], "as short as tells them apart"
    assert rows["best return"] == ["5", "9"] and rows["evaluation"] == ["-", "9"]
    assert rows["seed"] == ["1", "2"] and "num_envs" not in rows


def test_the_picture_has_a_curve_of_each_run_in_each_panel(pair, tmp_path):
    comparison.draw(pair, tmp_path / "compare.png")
    image = imageio.imread(tmp_path / "compare.png")[..., :3].astype(int)
    height, width = image.shape[:2]
    for color in ([31, 119, 180], [255, 127, 14]):  # Matplotlib's first two
        near = abs(image - color).sum(-1) < 60
        for row in (near[: height // 2], near[height // 2 :]):
            for panel in (row[:, : width // 2], row[:, width // 2 :]):
                assert panel.sum() > 50


def test_runs_without_metrics_are_refused(tmp_path):
    runs = [make_run(tmp_path / name, returns=()) for name in "ab"]
    with pytest.raises(ValueError, match=r"no metrics\.csv with rows to draw"):
        comparison.draw(runs, tmp_path / "compare.png")


def test_a_config_that_is_more_than_data_is_refused(pair):
    (pair[0] / "config.yaml").write_text("task_name: ${oc.env:HOME}\n")
    with pytest.raises(ValueError, match="an interpolation"):
        comparison.figures(pair)
