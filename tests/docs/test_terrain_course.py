"""The table of rough ground has the last run of each task on a GPU."""

from typing import Any

from benchmarks.pages.terrain_course import table
from ksim_rl.tasks.rough_ground import PATCHES


def test_a_row_shows_the_last_run_on_a_gpu_and_no_other():
    figures = {"success": 0.5, "fell": 0.25, "levels": 3}

    def run(label: str, date: str, success: float) -> tuple[dict[str, Any], dict[str, Any]]:
        prefix = f"{label}/go1_velocity_rough"
        own = {
            f"{prefix}/{kind}/{name}": value for kind in PATCHES for name, value in figures.items()
        }
        own |= {
            f"{prefix}/{name}": value for name, value in (figures | {"success": success}).items()
        }
        own |= {f"{prefix}/env_states": 250_085_376, f"{prefix}/trained_level": 5.61}
        made = {"date": date, "device": label.upper(), "commit": "0123456789-dirty"}
        return own, {prefix: made, f"{prefix}/flat": made}

    runs = [
        run("h200", "2026-01-01", 0.1),
        run("h100", "2026-01-02", 0.875),
        run("cpu", "2026-01-03", 0.3),
    ]
    saved = {"figures": {}, "runs": {}}
    for own, made in runs:
        saved["figures"] |= own
        saved["runs"] |= made
    shown = table(saved)
    assert "| mean | 87.5% | 25.0% | 3.0 | – | – | – |" in shown.splitlines()
    assert "| stairs_up | 50.0% | 25.0% | 3 | – | – | – |" in shown.splitlines()
    assert (
        "`go1_velocity_rough`: a policy after 250 million env states, with a mean level of 5.6 (of 0 to 9) in "
        "training, on H100 at commit 0123456." in shown.splitlines()
    )
    assert "`g1_velocity_rough` was not measured yet." in shown.splitlines()
