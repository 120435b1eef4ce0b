"""This module loads and checks a model from a file, an XML string, a spec or a menagerie name."""

import os
import re
import warnings
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import mujoco
import warp as wp

from ksim_rl.checks import naming, near
from ksim_rl.device.streams import start_warp
from ksim_rl.files.reading import MOST_MODEL_BYTES, read_bytes
from ksim_rl.physics.model_checks import check_finite, check_meant, warp_model_of
from ksim_rl.physics.model_size import check_text
from ksim_rl.physics.sim_cfg import SimCfg

SUFFIXES = (".xml", ".mjcf", ".urdf")
Source = str | Path | mujoco.MjSpec

_MENAGERIE_NAME = re.compile(r"[A-Za-z0-9_-]+(/[A-Za-z0-9_-]+)?")
_ELEMENT = re.compile(r"Element '(?P<tag>[^']*)', line (?P<line>\d+)")
_NAMED_ELEMENT = re.compile(r"Element name '(?P<name>[^']*)', id (?P<id>-?\d+)(, line (?P<line>\d+))?")
_FILE_IN_MESSAGE = re.compile(r"file '(?P<file>[^']+)'")
_SINGULAR = re.compile(r"Inertia matrix is too close to singular.* DOF (?P<dof>\d+)")
_NAN_ATTRIBUTE = re.compile(r"=\s*[\"'][^\"']*\b[nN][aA][nN]\b")
_PREFIXES = re.compile(r"^(XML Error: )?(Error: )?(ParseXML: )?")
_LINE = re.compile(r"[Ll]ine number=(?P<line>\d+)")
# Of specs that are edited and compiled later, when only their folder is known to MuJoCo.
_labels: weakref.WeakKeyDictionary[mujoco.MjSpec, str] = weakref.WeakKeyDictionary()


def load_spec(source: Source) -> mujoco.MjSpec:
    """Parse a model into an editable spec.

    The source is the path of an MJCF or URDF file, an XML string, a spec (which is copied), or a menagerie name such as
    "unitree_go1" or "unitree_go1/go1". Errors name the file and the element.
    """
    spec, _, label, caught = _parsed(source)
    _pass_on(caught, label)
    _labels[spec] = label
    return spec


def load_model(source: Source, sim: SimCfg | None = None) -> mujoco.MjModel:
    """Compile what `load_spec` parses, and check that its numbers make sense and MuJoCo Warp can simulate it.

    Settings of `sim` are laid over its own first, such as a solver that MuJoCo Warp has. What a few words make enormous
    is refused unless the environment variable KSIM_RL_LARGEST_MODEL allows it.
    """
    spec, text, label, caught = _parsed(source)
    if sim is not None:
        sim.apply_to(spec)
    with caught_warnings() as caught_later, _named(label, text):
        mj_model = spec.compile()
    check_finite(mj_model, label)
    for message in caught + caught_later:
        _refuse_serious(message, mj_model, label, text)
    check_meant(mj_model, label)
    _pass_on(caught + caught_later, label)
    start_warp()
    with wp.ScopedDevice("cpu"), naming(label):
        warp_model_of(mj_model)
    return mj_model


def _parsed(source: Source) -> tuple[mujoco.MjSpec, str, str, list[str]]:
    """Return the spec, its XML text and its name for messages, and MuJoCo's warnings."""
    if not isinstance(source, (str, Path)):
        if not isinstance(source, mujoco.MjSpec):
            kind = type(source).__name__
            raise ValueError(
                f"model source is {kind}: expected a path, an XML string, a MjSpec or a menagerie name"
            )
        return source.copy(), "", _labels.get(source, f"model {source.modelname!r}"), []
    path, text, label = _read(source)
    check_text(text, path.parent if path else Path(), label)
    with caught_warnings() as caught, _named(label, text):
        spec = mujoco.MjSpec.from_string(text) if path is None else mujoco.MjSpec.from_file(str(path))
    return spec, text, label, caught


@contextmanager
def _named(label: str, text: str) -> Iterator[None]:
    """Name the source and the element in whatever MuJoCo raises."""
    try:
        yield
    except (ValueError, RuntimeError, MemoryError, mujoco.FatalError) as error:
        raise ValueError(_readable(str(error), label, text)) from None


def _read(source: str | Path) -> tuple[Path | None, str, str]:
    """Return the path (None for an XML string), the XML text, and how to call the source in messages."""
    if isinstance(source, str):
        if not source.strip():
            raise ValueError(
                "model source is an empty string: expected a path, an XML string or a menagerie name"
            )
        if source.lstrip().startswith("<"):
            return None, source, "XML string"
        if _MENAGERIE_NAME.fullmatch(source) and not Path(source).exists():
            source = model_path(source)
    path = Path(source)
    if path.is_dir() or not path.exists():
        raise ValueError(f"model file {str(path)!r}: {'is a folder' if path.is_dir() else 'no such file'}")
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"model file {str(path)!r}: expected a name that ends in {', '.join(SUFFIXES)}")
    try:
        text = read_bytes(path, limit=MOST_MODEL_BYTES, follows_links=True).decode()
    except UnicodeDecodeError as error:
        raise ValueError(f"model file {str(path)!r} is not UTF-8 text: byte {error.start}") from None
    except ValueError as error:
        raise ValueError(f"model file {error}") from None
    if not text.strip():
        raise ValueError(f"model file {str(path)!r} is empty")
    return path, text, str(path)


def _readable(message: str, label: str, text: str) -> str:
    """Put MuJoCo's message on one line, with the source and the element."""
    message = message.strip()
    what = _PREFIXES.sub("", message.splitlines()[0])
    if message.startswith("XML parse error"):
        line = _LINE.search(message)
        number = int(line["line"]) if line else 0
        return f"{label}: not well-formed XML{_at_line(text, number)}"
    if found := _ELEMENT.search(message):
        return f"{label}: {what} (element <{found['tag']}>{_at_line(text, int(found['line']))})"
    if found := _NAMED_ELEMENT.search(message):
        called = f"{found['name']!r}" if found["name"] else f"number {found['id']} (unnamed)"
        return f"{label}: {what} (element {called}{_at_line(text, int(found['line'] or 0))})"
    if found := _FILE_IN_MESSAGE.search(message):
        lines = [number for number, line in enumerate(text.splitlines(), 1) if found["file"] in line]
        return f"{label}: {what}{_at_line(text, lines[0]) if lines else ''}"
    return f"{label}: {what}"


def _at_line(text: str, number: int) -> str:
    lines = text.splitlines()
    if not 1 <= number <= len(lines):
        return f", line {number}" if number else ""
    return f", line {number}: {lines[number - 1].strip()[:120]}"


def _refuse_serious(message: str, mj_model: mujoco.MjModel, label: str, text: str) -> None:
    """Refuse what MuJoCo only warns of, though no simulation of it can be right."""
    if found := _SINGULAR.search(message):
        joint = mj_model.joint(int(mj_model.dof_jntid[int(found["dof"])])).name
        raise ValueError(
            f"{label}: the inertia that joint {joint!r} moves is not positive at the initial pose"
        )
    if "contains a 'NaN'" in message:
        lines = [number for number, line in enumerate(text.splitlines(), 1) if _NAN_ATTRIBUTE.search(line)]
        raise ValueError(f"{label}: a value is NaN{_at_line(text, lines[0]) if lines else ''}")


def _pass_on(caught: list[str], label: str) -> None:
    for text in dict.fromkeys(caught):
        warnings.warn(f"{label}: {text}", UserWarning, stacklevel=3)


@contextmanager
def caught_warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings, which else go to the terminal and into a file MUJOCO_LOG.TXT."""
    caught: list[str] = []

    def keep(text: bytes | str) -> None:
        caught.append((text.decode(errors="replace") if isinstance(text, bytes) else text).strip())

    previous = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(keep)
    try:
        with warnings.catch_warnings(record=True) as from_bindings:
            warnings.simplefilter("always")
            yield caught
        for warning in from_bindings:
            keep(str(warning.message))
    finally:
        mujoco.set_mju_user_warning(previous)


def model_path(name: str) -> Path:
    """Return the file of a robot: "unitree_go1" (its scene), or "unitree_go1/go1" (one of its entry points).

    Looks under the folder that the environment variable MENAGERIE_ROOT names, else in the cache of the package
    `mujoco-menagerie`, which downloads a robot on first use.
    """
    robot, _, entry = name.partition("/")
    root = os.environ.get("MENAGERIE_ROOT")
    return _in_folder(Path(root), robot, entry) if root else _from_package(robot, entry)


def _in_folder(root: Path, robot: str, entry: str) -> Path:
    if not (root / robot).is_dir():
        found = [path.name for path in root.iterdir() if path.is_dir()] if root.is_dir() else []
        raise ValueError(
            f"menagerie model {robot!r} is not under MENAGERIE_ROOT={root}: {near(robot, found)}; copy its "
            "folder there, or unset MENAGERIE_ROOT to download it with the package mujoco-menagerie"
        )
    stem = entry or "scene"
    path = root / robot / f"{stem}.xml"
    if not path.is_file():
        found = [path.stem for path in (root / robot).glob("*.xml")]
        raise ValueError(f"menagerie model {robot!r} has no entry point {stem!r}: {near(stem, found)}")
    return path


def _from_package(robot: str, entry: str) -> Path:
    try:
        import mujoco_menagerie
    except ImportError:
        raise ValueError(
            f"menagerie model {robot!r} is not here: with a network, `pip install mujoco-menagerie` (it downloads the "
            "model on first use); without one, copy the folder and set MENAGERIE_ROOT to its parent"
        ) from None
    try:
        return mujoco_menagerie.get(robot).xml(entry or None)
    except LookupError as error:
        raise ValueError(f"menagerie: {error}") from None
    except (mujoco_menagerie.MenagerieError, OSError) as error:
        raise ValueError(
            f"menagerie model {robot!r} could not be downloaded ({error}): with a network, try again; without one, "
            "copy its folder from github.com/google-deepmind/mujoco_menagerie and set MENAGERIE_ROOT to its parent"
        ) from None
