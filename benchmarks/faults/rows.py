"""All rows, in the order of the page."""

from __future__ import annotations

from benchmarks.faults import (
    bad_input,
    crowded_commands,
    damaged_caches,
    disk,
    environments,
    exports,
    gpu,
    growth,
    hostile_folder,
    interrupts,
    killed_commands,
    machine,
    numbers,
    saving,
    seen_soak,
    strangers,
    viewer,
)
from benchmarks.faults.row import Row

ROWS: dict[str, Row] = {
    **saving.ROWS,
    **disk.ROWS,
    **interrupts.ROWS,
    **killed_commands.ROWS,
    **crowded_commands.ROWS,
    **numbers.ROWS,
    **strangers.ROWS,
    **hostile_folder.ROWS,
    **viewer.ROWS,
    **exports.ROWS,
    **bad_input.ROWS,
    **machine.ROWS,
    **environments.ROWS,
    **damaged_caches.ROWS,
    **growth.ROWS,
    **seen_soak.ROWS,
    **gpu.ROWS,
}
