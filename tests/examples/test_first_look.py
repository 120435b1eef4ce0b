"""The notebook runs from top to bottom on the CPU, and its policy learns."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).parents[2] / "examples" / "first_look.ipynb"


def said(cell: nbformat.NotebookNode) -> str:
    return "".join(output.get("text", "") for output in cell.outputs)


def test_it_is_committed_without_outputs() -> None:
    cells = nbformat.read(NOTEBOOK, as_version=4).cells
    assert all(
        not cell.outputs and cell.execution_count is None
        for cell in cells
        if cell.cell_type == "code"
    )


@pytest.mark.full
def test_it_runs_from_top_to_bottom(tmp_path: Path) -> None:
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": tmp_path}}).execute()
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert "observations/actor (5,)" in said(code[0])
    assert "one step late: True" in said(code[3])
    assert "return_mean" in said(code[4])
    pictures = [
        cell
        for cell in code
        if any("image/png" in output.get("data", {}) for output in cell.outputs)
    ]
    assert len(pictures) == 2
    assert not list(tmp_path.iterdir())  # it leaves nothing behind
