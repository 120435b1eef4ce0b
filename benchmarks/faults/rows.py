"""All rows, in the order of the page."""

from __future__ import annotations

from benchmarks.faults import disk, growth, interrupts, saving
from benchmarks.faults.row import Row

ROWS: dict[str, Row] = {
    **saving.ROWS,
    **disk.ROWS,
    **interrupts.ROWS,
    **growth.ROWS,
}
