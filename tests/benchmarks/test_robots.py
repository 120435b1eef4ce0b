"""The list of robots' files is whole, and an attempt says what came of a file."""

import pytest
import yaml

from benchmarks.robots.__main__ import LIST, figures_of, read_list
from benchmarks.robots.attempt import Attempt, Listed, attempt
from tests.scene.robots.test_strangers import dog


def test_the_list_has_forty_files_and_says_of_each_what_it_is():
    listed = read_list()
    assert len(listed) >= 40 and len({entry.path for entry in listed}) == len(listed)
    assert all(bool(entry.feet) != bool(entry.refusal) for entry in listed)
    assert len(listed) == len(yaml.safe_load(LIST.read_text()))


@pytest.mark.full
def test_a_walker_is_trained_and_other_feet_are_not_as_listed(tmp_path):
    (tmp_path / "dog.xml").write_text(dog())
    feet = [f"{end}_{side}_shank" for end in ("front", "rear") for side in ("left", "right")]
    found = attempt(Listed(path="dog.xml", feet=feet), tmp_path)
    assert (found.outcome, found.as_listed, found.trained) == ("stands", True, 3), found.said
    assert not attempt(Listed(path="dog.xml", feet=feet[:2]), tmp_path).as_listed


@pytest.mark.parametrize(("refusal", "as_listed"), [("0 free joints", True), ("no feet", False)])
def test_other_files_get_the_line_of_the_list(tmp_path, refusal, as_listed):
    (tmp_path / "arm.xml").write_text("<mujoco><worldbody><body/></worldbody></mujoco>")
    found = attempt(Listed(path="arm.xml", refusal=refusal), tmp_path)
    assert (found.outcome, found.as_listed) == ("refused", as_listed)
    assert str(tmp_path) not in found.said


def test_what_is_no_valueerror_is_a_traceback_and_counted(tmp_path, monkeypatch):
    def broken(path):
        raise KeyError(path.name)

    monkeypatch.setattr("benchmarks.robots.attempt.analyse", broken)
    found = attempt(Listed(path="dog.xml", feet=["a"]), tmp_path)
    assert found.outcome == "traceback" and "KeyError" in found.said
    walker, arm = Listed(path="a", feet=["a"]), Listed(path="b", refusal="b")
    stands = Attempt(outcome="stands", as_listed=True, trained=3)
    figures = figures_of({"a": (walker, stands), "b": (arm, found), "c": (walker, found)})
    assert (figures["files"], figures["walkers_that_stand"], figures["tracebacks"]) == (3, 0.5, 2)
