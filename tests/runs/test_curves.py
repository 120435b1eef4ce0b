"""The picture of the learning curves."""

import imageio.v2 as imageio
import pytest

from ksim_rl.runs.curves import draw
from ksim_rl.trainers.loggers import CsvTable


@pytest.fixture
def table(tmp_path):
    table = CsvTable(tmp_path / "metrics.csv")
    for step in range(1, 6):
        metrics = {
            "episode/return": step * 10.0,
            "loss/value": 1.0 / step,
            "throughput/env_states_per_s": 5e4,
        }
        if step % 2 == 0:
            metrics["evaluation/return_mean"] = step * 12.0
        table.log_metrics(metrics, step * 100)
    return table.path


def test_the_picture_has_a_drawn_panel_per_metric(tmp_path, table):
    picture = tmp_path / "curves.png"
    draw(table, picture, title="probe", solved_at=45.0)
    image = imageio.imread(picture)[..., :3]
    height, width = image.shape[:2]
    assert width > 900
    # Three panels side by side, each with ink of the curve's blue in it.
    for panel in range(3):
        part = image[:, panel * width // 3 : (panel + 1) * width // 3].astype(int)
        blue = (abs(part - [52, 101, 164]).sum(-1) < 40).sum()
        assert blue > 50, panel
    assert height < width


def test_an_empty_table_is_refused(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text("env_states\n")
    with pytest.raises(ValueError, match="no rows to draw"):
        draw(path, tmp_path / "curves.png", title="probe")
