"""Reads a table: rows (task, objective, overrides, env states, seeds), measures, and published figures.

A file has groups, whose rows inherit the fields of their group; docs/tables.md shows one.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

from ksim_rl.checked import Checked, Count, Positive, Seed, Share, WholeNumber
from ksim_rl.checks import naming, unknown_name
from ksim_rl.config import plain_data
from ksim_rl.config.config_tree import from_tree
from ksim_rl.config.trees import Tree
from ksim_rl.tables.rules import check_name, check_override

SUFFIX = ".yaml"
FOLDER = Path(str(files("ksim_rl.tables")))
COURSE_LEAST = "evaluation/course_least"
"""The least share of robots, over kinds of ground, that cross the row's level of the course."""


@dataclass(frozen=True, kw_only=True)
class Row(Checked):
    """One setting that is trained with some seeds.

    Attributes:
        overrides: of `ksim-rl train`, beside task, objective and seed.
        env_states: that training collects at most: as many iterations as fit.
        seeds: the seeds that count. They are for nothing else: settings are chosen with other ones.
        measure: "return" of the final evaluation, the mean over the seeds; or "seconds" of training until `levels` of
            training metrics hold, the median over the seeds, one that does not get there counting as infinite; or
            "success" of the final policy in `episodes` trials of a tracking task, the lowest over the seeds.
        episodes: of the final evaluation: deterministic actions, fresh envs.
        levels: of training metrics, which seconds wait for: at least, and at most of errors, which
            `ksim_rl.tables.levels.less_is_better` tells by their names; with another measure each seed should have them
            in the mean of its last million env states. There `evaluation/metric/<name>` is of the final evaluation's
            episodes.
        within_s: seconds in which the levels should be reached.
        at_least: share of trials that should succeed.
        most_falls: share of these episodes, or with a course of the robots on it, that may end in a termination before
            their time; the worst seed counts.
        course_level: the final policy also walks the course of its rough ground (`ksim_rl.tasks.terrain_course`), and
            the shares of robots that succeed on each kind of ground at this level count, the easiest being 0.
        course_least: the least of these shares that is asked for, over kinds and seeds.
        recorded: so many episodes of the final policy, with its draws, are kept for rows that learn from them.
        learns_from: the row above whose recorded episodes it learns from, seed by seed: they become
            `objective.episodes` of `bc`, and else `data.offline`, with its share of a half.
        begins_from: the row above whose final networks it begins with, seed by seed.
        taught_by: the row above whose final policy teaches this one by `distillation`, seed by seed. Where both have a
            `course_level`, `share_of_teacher` compares how many robots succeed on their courses.
        saves_over: the row above, without such a beginning, that it is compared with: how many env states it saves.
        figures: further figures by name. Each has a source: "seconds" of the whole training, "success" of the trials,
            or one of the means of the end, such as `evaluation/metric/<name>`.
        published: returns that others report, by who; `against` names the one to reach, "" none.
    """

    task: str
    objective: str
    env_states: Positive
    seeds: tuple[Seed, ...]
    overrides: tuple[str, ...] = ()
    measure: Literal["return", "seconds", "success"] = "return"
    episodes: Count = 128
    levels: Mapping[str, float] = field(default_factory=dict)
    within_s: Positive | None = None
    at_least: Share | None = None
    most_falls: Share | None = None
    figures: Mapping[str, str] = field(default_factory=dict)
    course_level: WholeNumber | None = None
    course_least: Share | None = None
    published: Mapping[str, float] = field(default_factory=dict)
    against: str = ""
    recorded: WholeNumber = 0
    learns_from: str = ""
    begins_from: str = ""
    taught_by: str = ""
    saves_over: str = ""

    def _check_fields(self) -> None:
        super()._check_fields()
        # A seed that is there twice would count twice.
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds={self.seeds!r}: expected at least one, and each once")
        if self.measure == "seconds" and not self.levels:
            raise ValueError(
                "levels={}: measure=seconds waits until metrics reach some; give one at least"
            )
        for name, source in self.figures.items():
            self._check_figure(name, source)
        if self.course_least is not None and self.course_level is None:
            raise ValueError(
                f"course_least={self.course_least}: it is of a level of the course; give course_level, too"
            )
        check_name("task", self.task)
        check_name("objective", self.objective)
        # Names and words go into paths and command lines: signs with a meaning there are refused.
        for word in self.overrides:
            check_override(word)

    def _check_figure(self, name: str, source: str) -> None:
        """Refuse a further figure that no result has, or that has the name of another one."""
        check_name("figures", name)
        if name in (self.measure, "falls"):
            raise ValueError(
                f"figures.{name}: measure={self.measure} writes it: choose another name"
            )
        if source == "success" and self.measure != "success":
            raise ValueError(
                f"figures.{name}='success': measure={self.measure} runs no trials: set measure=success, or name "
                "a mean such as evaluation/metric/success"
            )
        if source == COURSE_LEAST and self.course_level is None:
            raise ValueError(
                f"figures.{name}={source!r}: no course is walked: set course_level, or leave the figure out"
            )
        is_mean = source in self.levels or source.startswith("evaluation/")
        if source not in ("seconds", "success") and not is_mean:
            raise ValueError(
                f"figures.{name}={source!r}: expected seconds, success, evaluation/..., or one of the levels: "
                f"{', '.join(self.levels) or 'there are none'}"
            )

    @property
    def goal(self) -> float | None:
        """The bound of the measure: the least return or share, the most seconds; None where there is none."""
        # The measure decides what counts: a return is compared with a publication.
        goals = {"success": self.at_least, "seconds": self.within_s}
        return goals.get(self.measure, self.published.get(self.against))


@dataclass(frozen=True, kw_only=True)
class Mean(Checked):
    """A mean over the rows of each group, but for some; `at_least` has the goals by group."""

    without: tuple[str, ...] = ()
    at_least: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Table(Checked):
    """Rows by `<group>/<name>`, or by name in the group ""; `notes` stands below, `source` is `load`'s argument."""

    name: str
    source: str = ""
    title: str
    rows: Mapping[str, Row]
    means: Mapping[str, Mean] = field(default_factory=dict)
    notes: str = ""

    def _check_fields(self) -> None:
        super()._check_fields()
        above: dict[str, Row] = {}
        for name, row in self.rows.items():
            for field_name in ("learns_from", "begins_from", "taught_by", "saves_over"):
                self._check_source(name, field_name, above)
            if row.learns_from and not above[row.learns_from].recorded:
                raise ValueError(
                    f"rows.{name}.learns_from={row.learns_from!r}: that row keeps no episodes: set its `recorded`"
                )
            above[name] = row

    def _check_source(self, name: str, field_name: str, above: Mapping[str, Row]) -> None:
        """Refuse a row that is not above, so that there are no circles, or that lacks a seed."""
        row = self.rows[name]
        source = getattr(row, field_name)
        if not source:
            return
        if source not in above:
            raise ValueError(
                f"rows.{name}.{field_name}={source!r}: expected the name of a row above it: "
                f"{', '.join(above) or 'there is none'}"
            )
        if above[source].seeds != row.seeds:
            raise ValueError(
                f"rows.{name}.{field_name}={source!r}: it has the seeds {above[source].seeds}, and this row {row.seeds}"
            )

    def groups(self) -> dict[str, list[str]]:
        """Return the names of the rows of each group."""
        found: dict[str, list[str]] = {}
        for name in self.rows:
            found.setdefault(name.rpartition("/")[0], []).append(name)
        return found


def shipped() -> list[str]:
    """Return the names of the tables that come with the package."""
    return sorted(path.stem for path in FOLDER.glob(f"*{SUFFIX}"))


def load(name: str) -> Table:
    """Read a table of the package by name, or a file of yours by path; a ValueError names the fault."""
    if name.endswith(SUFFIX):
        path = Path(name)
    else:
        path = FOLDER / f"{name}{SUFFIX}"
    # A name without a file: the near names help.
    if path.parent == FOLDER and path.stem not in shipped():
        raise unknown_name("table", name, shipped())
    tree = plain_data.read_yaml(path)
    if isinstance(tree, dict):
        # Rows stand in groups in the file, and side by side in a table.
        groups = tree.pop("groups", None)
    else:
        groups = None
    with naming(str(path)):
        rows = _rows(groups)
    # A name in the tree wins over the file's name; rows and source are always ours.
    table = from_tree(Table, {"name": path.stem, **tree, "source": name, "rows": rows}, str(path))
    with naming(str(path)):
        check_name("name", table.name)
    return table


def _rows(groups: Any) -> Tree:
    """Return the fields of each row by `<group>/<name>`, with the fields of its group."""
    if isinstance(groups, dict):
        found = groups
    else:
        found = {"": {}}
    rows = {}
    for group, fields in found.items():
        if not isinstance(fields, dict) or not isinstance(fields.get("rows"), dict):
            raise ValueError("expected a mapping with a title, and groups that have rows")
        # The group "" is for tables without groups.
        if group != "":
            check_name("group", group)
        # Fields of a group hold for all its rows, which may replace them.
        shared = {key: value for key, value in fields.items() if key != "rows"}
        for row, own in fields["rows"].items():
            check_name("row", row)
            if own is not None and not isinstance(own, dict):
                raise ValueError(f"row {row!r} is {own!r}: expected its fields")
            rows[f"{group}/{row}" if group else str(row)] = {**shared, **(own or {})}
    return rows
