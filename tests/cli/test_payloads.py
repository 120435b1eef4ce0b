"""Run folders of strangers: what could execute, leak or write elsewhere is refused in one line.

Each family of payloads is generated here, over every kind of file that a run folder holds, and is shown to work where
its check is removed: so the check is what stops it, and not luck.
"""

import pytest

from ksim_rl.config import plain_data
from tests.cli.payloads import FAMILIES, call, signs
from tests.cli.test_foreign_files import DATA_FILES


@pytest.mark.parametrize("name", FAMILIES)
def test_a_payload_is_refused_in_one_line_and_does_nothing(name, place, capsys):
    command = FAMILIES[name][0](place)
    before = sorted(map(str, place.run.parent.rglob("*")))
    assert call(command) == 2
    error = capsys.readouterr().err
    assert error.startswith("ksim-rl: error: ") and error.count("\n") == 1, error
    assert signs(place, error) == []
    after = sorted(
        str(path) for path in place.run.parent.rglob("*") if "__pycache__" not in str(path)
    )
    assert after == before, "nothing is written"


EXPLODED = 10_000


# Evidence for the tests above, which all run: of each third family here, and of all in `make test-full`.
SHOWN = [
    pytest.param(name, marks=[pytest.mark.full] if number % 3 else [])
    for number, name in enumerate(FAMILIES)
]


@pytest.mark.parametrize("name", SHOWN)
def test_a_payload_works_where_its_check_is_removed(name, place, capsys, monkeypatch):
    write, without = FAMILIES[name]
    without(monkeypatch)
    sizes = []
    monkeypatch.setattr(plain_data, "check_plain", lambda tree, where: sizes.append(len(str(tree))))
    command = write(place)
    call(command)
    error = capsys.readouterr().err
    found = signs(place, error)
    assert found or max(sizes, default=0) > EXPLODED, error


def test_there_are_families_over_every_kind_of_file():
    assert len(FAMILIES) + len(DATA_FILES) >= 12
