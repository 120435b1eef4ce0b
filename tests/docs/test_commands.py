"""What README and docs name exists: the fields in commands, benchmarks, files, pictures, anchors."""

import importlib.util
import re
import shlex
from pathlib import Path

import pytest

from ksim_rl import conf, envs
from ksim_rl.cli.main import COMMANDS
from tests.docs.guide import DOCS, REPOSITORY

_PAGES = (*sorted(REPOSITORY.glob("*.md")), *sorted(DOCS.rglob("*.md")))
PAGES = {page.relative_to(REPOSITORY).as_posix(): page.read_text() for page in _PAGES}
ALL = "\n".join(PAGES.values())
FLAGS = {"--multirun": 0, "--cfg": 1}
# Tasks that the reader writes.
THEIRS = {"puck_center", "stool_velocity_flat", "my_task"}


def train_commands() -> list[str]:
    """The overrides of each `ksim-rl train` that a page shows, with one value of each sweep."""
    found = re.findall(r"ksim-rl train ([^`\n#]*)", ALL.replace("\\\n", " "))
    return sorted(
        {text.strip() for text in found if "--config-dir" not in text and "--help" not in text}
    )


def overrides(command: str) -> list[str]:
    # What the shell fills in from a file is not known here.
    words = shlex.split(re.sub(r"\$\([^)]*\)", "", command))
    for flag, values in FLAGS.items():
        if flag in words:
            start = words.index(flag)
            del words[start : start + 1 + values]
    swept = "--multirun" in command
    words = [word.split(",")[0] if swept else word for word in words]
    return [word.replace("device=cuda", "device=cpu") for word in words]


@pytest.mark.parametrize("command", train_commands())
def test_the_fields_of_a_command_exist(command: str) -> None:
    words = overrides(command)
    named = {word.removeprefix("task=") for word in words if word.startswith("task=")}
    if named & THEIRS or "task=<task>" in words or "--plugin" in words:
        pytest.skip("a task or a package that the reader writes")
    assert named <= set(envs.names())
    assert conf.compose(words).num_envs > 0


def test_the_commands_exist() -> None:
    named = set(
        re.findall(
            r"(?:^|[`$ ])ksim-rl ((?:--plugin \w+ )?[a-z_0-9]+)(?=[ `\n])", ALL, re.MULTILINE
        )
    )
    commands = {words.rpartition(" ")[2] for words in named}
    assert len(commands) > 12
    assert commands <= {*COMMANDS, "help"}


def test_fields_in_the_text_exist() -> None:
    fields = set(
        re.findall(r"`'?((?:objective|data|trainer|collector|task\.sim)\.(?!py\b)\w+)[=`]", ALL)
    )
    fields.remove("trainer.loggers")  # of a Trainer
    choices = (
        [],
        ["objective=distillation", "objective.teacher=RUN"],
        ["objective=bc", "objective.episodes=FOLDER"],
        ["objective=fast_sac"],
        ["task=walker_amp", "objective=amp"],
    )
    trees = [conf.compose(words).to_tree() for words in choices]
    assert len(fields) > 10
    for field in fields:
        *path, last = field.split(".")
        nodes = trees
        for name in path:
            nodes = [node[name] for node in nodes]
        assert any(last in node for node in nodes), field


def test_benchmarks_exist() -> None:
    named = set(re.findall(r"python -m (benchmarks\.\w+)", ALL))
    assert len(named) > 5
    for name in named:
        assert importlib.util.find_spec(name), name


def anchors(text: str) -> set[str]:
    """The anchors that GitHub gives the headings of a page."""
    headings = re.findall(
        r"^#+ (.+)$", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE), re.MULTILINE
    )
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("name", PAGES)
def test_links_lead_somewhere(name: str) -> None:
    folder = (REPOSITORY / name).parent
    for link in re.findall(r'\]\(([^)\s]+)\)|<img src="([^"]+)"', PAGES[name]):
        target = "".join(link)
        if target.startswith("https://"):
            continue
        path, _, anchor = target.partition("#")
        file = (folder / path).resolve() if path else REPOSITORY / name
        assert file.exists(), target
        if anchor:
            assert anchor in anchors(Path(file).read_text()), target
