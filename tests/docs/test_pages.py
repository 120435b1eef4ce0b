"""The pages that are made of code and results are as the command would write them."""

import pytest

from benchmarks.pages import made
from ksim_rl import mdp
from tests.docs.guide import DOCS


@pytest.mark.parametrize("name", made.NAMES)
def test_a_page_is_what_the_command_would_write(name: str) -> None:
    page = (DOCS / name).read_text()
    assert page == made.made(name), f"docs/{name} is out of date: python -m benchmarks.pages"


@pytest.mark.parametrize("name", made.PARTS)
def test_a_part_without_its_comments_is_refused(name: str, tmp_path, monkeypatch) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("# A page\n")
    monkeypatch.setattr(made, "DOCS", tmp_path)
    with pytest.raises(ValueError, match="put both where the table belongs"):
        made.made(name)


def test_the_page_of_terms_has_all_of_them() -> None:
    rows = (line for line in made.made("terms.md").splitlines() if line.startswith("| `"))
    assert sorted(line.split("`")[1] for line in rows) == mdp.__all__


def test_a_cpu_trains_at_the_speed_that_the_page_of_memory_says() -> None:
    figure = made.results("throughput")["figures"]["cpu/cartpole_balance/512/env_states_per_s"]
    assert f"trains at {round(figure, -2):,.0f} env states/s" in (DOCS / "memory.md").read_text()
