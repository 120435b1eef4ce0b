"""The page and the drawing of the architecture show every room of the package."""

import re

from tests import house
from tests.docs.guide import DOCS, REPOSITORY

PACKAGE = REPOSITORY / "ksim_rl"


def rooms() -> set[str]:
    """Return the folders directly under the package."""
    return {file.parent.name for file in PACKAGE.glob("*/__init__.py")}


def test_the_tables_have_each_room_once() -> None:
    page = (DOCS / "architecture.md").read_text()
    rows = [line.split(" | ")[0] for line in page.splitlines() if line.startswith("| [`")]
    linked = [name for row in rows for name in re.findall(r"\]\(\.\./ksim_rl/(\w+)\)", row)]
    assert len(linked) == len(set(linked))
    assert set(linked) == rooms()


def test_the_groups_are_those_of_the_house() -> None:
    page = (DOCS / "architecture.md").read_text()
    found: dict[str, set[str]] = {}
    for line in page.splitlines():
        if heading := re.match(r"\*\*(\w+)\*\*: ", line):
            group = heading[1].lower()
        elif line.startswith("| [`"):
            names = re.findall(r"\]\(\.\./ksim_rl/(\w+)\)", line.split(" | ")[0])
            found.setdefault(group, set()).update(names)
    found = {group: names for group, names in found.items() if names}
    assert found == {group: {*names} - {""} for group, names in house.GROUPS.items()}


def test_the_drawing_has_each_room() -> None:
    drawn = set(re.findall(r'class="room"[^>]*>(\w+)<', (DOCS / "rooms.svg").read_text()))
    # Modules of one file stand beside the folders.
    modules = {file.stem for file in PACKAGE.glob("*.py")}
    assert rooms() <= drawn
    assert drawn <= rooms() | modules


def test_the_reference_on_the_site_is_in_these_groups() -> None:
    site = (REPOSITORY / "mkdocs.yml").read_text()
    api = site.partition("  - API:\n")[2].partition("  - Changelog:")[0]
    found: dict[str, str] = {}
    for line in api.splitlines():
        if heading := re.fullmatch(r"      - (\w+):", line):
            group = heading[1].lower()
        elif page := re.search(r"reference/([\w.]+)\.md", line):
            found[page[1]] = group
    for module, group in found.items():
        # The doors `envs.tasks`, `envs.mdp` and their like lead to rooms of the same name.
        door = module.split(".")[-1]
        room = door if door in rooms() else module.split(".")[0]
        assert group == house.group_of(room), module
    assert set(found.values()) == set(house.GROUPS)
