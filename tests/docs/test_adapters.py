"""The code of docs/adapters.md runs as it stands."""

import re

from tests.docs.guide import DOCS


def test_the_env_of_another_library_resets() -> None:
    (text,) = re.findall(
        r"<!-- test: adapters -->\n```python\n(.*?)```",
        (DOCS / "adapters.md").read_text(),
        re.DOTALL,
    )
    names = {}
    exec(compile(text, "docs/adapters.md", "exec"), names)  # noqa: S102
    assert names["env"].reset().shape == (64, 5)
