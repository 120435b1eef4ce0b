"""Tables of strangers are refused in one line, before anything is written, deleted or read from the environment."""

import pytest

from tests.tables.strange_tables import STRANGE, tried


@pytest.mark.parametrize("name", STRANGE)
def test_a_strange_table_is_refused_in_one_line(name, tmp_path):
    code, said, signs = tried(name, tmp_path)
    assert (code, signs) == (2, []), said
    assert said.startswith("ksim-rl: error: ") and said.count("\n") == 1
