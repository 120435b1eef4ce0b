"""The page of transforms: it lists all of them, and its examples run as they stand."""

import re

import pytest

from tests.docs.guide import DOCS
from tests.transforms.portable import exported_transforms

PAGE = (DOCS / "transforms.md").read_text()
EXAMPLES = dict(re.findall(r"<!-- example: (\w+) -->\n```python\n(.*?)```", PAGE, re.DOTALL))


def test_every_transform_is_in_a_table_and_has_an_example():
    listed = re.findall(r"^\| \[`(\w+)`\]\(#(\w+)\)", PAGE, re.MULTILINE)
    assert {name for name, _ in listed} == exported_transforms()
    assert len(listed) == len(exported_transforms())
    assert all(anchor == name.lower() and f"### {name}\n" in PAGE for name, anchor in listed)
    assert EXAMPLES.keys() - {"chain", "config", "level"} == exported_transforms()
    assert PAGE.count("```python") == len(EXAMPLES)


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_example_runs_as_it_stands(name):
    exec(compile(EXAMPLES[name], f"docs/transforms.md: {name}", "exec"), {"__name__": name})  # noqa: S102
