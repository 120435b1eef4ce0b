"""Answers arguments that are spelled as other programs spell theirs."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from ksim_rl import envs
from ksim_rl.checks import near
from ksim_rl.conf.choices import DEFAULTS
from ksim_rl.conf.registration import RUN_CONFIG
from ksim_rl.config.trees import Plain

GROUPS = ("task", "objective", "data", "modules", "collector", "trainer", "logger")

MOTIONS = "task.scene.motions.clips.sources"
"""The field that `motions=FOLDER` stands for."""


def in_full(word: str) -> str:
    """Return `motions=FOLDER` as the field that it means, and any other argument as it is."""
    name, equals, value = word.partition("=")
    if name != "motions" or not equals:
        return word
    # Several folders and files are given as a list.
    listed = value if value.startswith("[") else f"[{value}]"
    return f"{MOTIONS}={listed}"


def of_flag(flag: str, arguments: Sequence[str] = ()) -> ValueError:
    """Build the error for a flag that does not exist, such as `--num_envs=4`, or `--task x` in `arguments`."""
    name, equals, value = flag.lstrip("-").partition("=")
    if not equals:
        if flag in arguments:
            # `--task x`: the value is the argument behind it.
            after = list(arguments)[list(arguments).index(flag) + 1 :]
        else:
            after = []
        if after and not after[0].startswith("-") and "=" not in after[0]:
            value = after[0]
        else:
            value = "VALUE"
    # Flags are written with dashes, fields with underscores.
    name = name.replace("-", "_")
    known = [*GROUPS, *_fields(DEFAULTS)]
    # The whole path, else all fields that end in the name.
    found = [field for field in known if field == name] or [
        field for field in known if field.endswith(f".{name}")
    ]
    if not found and name.partition(".")[0] not in known:
        return ValueError(f"{flag}: no such flag, and no field {name!r}: {near(name, known)}")
    # Three are enough: a name such as `seed` stands in many places.
    options = " or ".join(f"{field}={value}" for field in (found or [name])[:3])
    return ValueError(f"{flag}: fields are set without dashes: {options}")


def of_word(word: str) -> ValueError | None:
    """Build the error for an argument that is no `name=value`, if it names a task or a run."""
    # A folder as an argument: the three things that one may want with a run.
    if (Path(word) / RUN_CONFIG).exists():
        return ValueError(
            f"{word!r}: expected name=value; make this run once more with --config-dir {word}, start from its weights "
            f"with checkpoint={word}, or continue it with: ksim-rl resume {word}"
        )
    # A near task name is most likely what was meant.
    hint = near(word, envs.names())
    if not hint.startswith("did you mean"):
        return None
    return ValueError(
        f"{word!r}: expected name=value: {hint.replace(chr(39), '').replace('mean ', 'mean task=')}"
    )


def _fields(tree: Mapping[str, Plain], path: str = "") -> Iterator[str]:
    for name, value in tree.items():
        yield f"{path}{name}"
        if isinstance(value, Mapping):
            yield from _fields(value, f"{path}{name}.")
