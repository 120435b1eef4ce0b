"""The page about learning: it lists what there is, and its examples run as they stand."""

import re

import pytest
from hydra.core.config_store import ConfigStore

from ksim_rl import conf
from tests.docs.guide import DOCS

PAGE = (DOCS / "learning.md").read_text()
EXAMPLES = dict(re.findall(r"<!-- example: (\w+) -->\n```python\n(.*?)```", PAGE, re.DOTALL))


@pytest.mark.parametrize("group", ["objective", "modules"])
def test_every_choice_of_a_group_is_in_its_table(group):
    conf.register()
    choices = {name.removesuffix(".yaml") for name in ConfigStore.instance().repo[group]}
    table = PAGE.split(f"| `{group}=` |")[1].split("\n\n")[0]
    listed = {
        name for row in table.splitlines()[1:] for name in re.findall(r"`(\w+)`", row.split("|")[1])
    }
    assert listed == choices


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_example_runs_as_it_stands(name):
    exec(compile(EXAMPLES[name], f"docs/learning.md: {name}", "exec"), {"__name__": name})  # noqa: S102
