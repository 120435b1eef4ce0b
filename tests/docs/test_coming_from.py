"""The names of ours that docs/coming_from.md gives for names of other software exist."""

import importlib
import re

import pytest

from tests.docs.guide import DOCS

ROWS = [
    line.strip("| ").split(" | ")[-1]
    for line in (DOCS / "coming_from.md").read_text().splitlines()
    if line.startswith("| ") and not line.startswith("|---")
]
NAMES = sorted({name for row in ROWS for name in re.findall(r"`((?:\w+\.)*[A-Z]\w+)`", row)})


@pytest.mark.parametrize("name", NAMES)
def test_a_name_exists(name: str) -> None:
    module, _, last = name.rpartition(".")
    found = importlib.import_module(
        module if module.startswith("ksim_rl") else f"ksim_rl.envs.{module}".rstrip(".")
    )
    assert hasattr(found, last)


def test_every_table_has_names() -> None:
    assert len(NAMES) > 40
