"""The faults that docs/upstream.md reports are still there; a block that fails says that a workaround can go."""

import re
import subprocess
import sys

import pytest

from tests.docs.guide import DOCS

TEXTS = dict(
    re.findall(r"^## (.*)\n((?:(?!## ).*\n)*)", (DOCS / "upstream.md").read_text(), re.MULTILINE)
)
BLOCKS = {
    title: re.findall(r"```python\n(.*?)```", text, re.DOTALL) for title, text in TEXTS.items()
}
REPRODUCED = [title for title, blocks in BLOCKS.items() if blocks]


def test_each_report_has_one_reproduction_or_says_that_it_is_not_reduced() -> None:
    assert len(BLOCKS) >= 6
    for title, blocks in BLOCKS.items():
        assert len(blocks) == (0 if "not reduced yet" in title else 1), title


@pytest.mark.full
@pytest.mark.parametrize("title", REPRODUCED)
def test_the_fault_is_still_there(title: str) -> None:
    # Twice at most: where kernels had to be compiled, the first run measures that.
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", BLOCKS[title][0]], capture_output=True, text=True, check=False
        )
        if done.returncode == 0:
            break
    assert done.returncode == 0, f"{title}: mended? {done.stdout[-500:]} {done.stderr[-500:]}"
