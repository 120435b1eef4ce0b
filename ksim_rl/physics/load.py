"""Loads and checks a model from a file, an XML string, a spec or a menagerie name."""

import re
import warnings
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import mujoco
import warp as wp

from ksim_rl.checks import naming
from ksim_rl.device.streams import start_warp
from ksim_rl.physics.model_checks import check_finite, check_meant, warp_model_of
from ksim_rl.physics.model_files.source import read_source
from ksim_rl.physics.model_files.urdf import is_urdf, ready_urdf
from ksim_rl.physics.model_size import check_text
from ksim_rl.physics.sim_cfg import SimCfg

Source = str | Path | mujoco.MjSpec

_ELEMENT = re.compile(r"Element '(?P<tag>[^']*)', line (?P<line>\d+)")
_NAMED_ELEMENT = re.compile(
    r"Element name '(?P<name>[^']*)', id (?P<id>-?\d+)(, line (?P<line>\d+))?"
)
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
    # Specs have no file name of their own: later messages need the label.
    _pass_on(caught, label)
    _labels[spec] = label
    return spec


def load_model(source: Source, sim: SimCfg | None = None) -> mujoco.MjModel:
    """Compile the spec of `load_spec`, and check that its numbers make sense and MuJoCo Warp can simulate it.

    Settings of `sim` are laid over its own first, such as a solver that MuJoCo Warp has. A model that a few words make
    enormous is refused unless the environment variable KSIM_RL_LARGEST_MODEL allows it.
    """
    spec, text, label, caught = _parsed(source)
    # Before compiling, since the compiler reads options, too.
    if sim is not None:
        sim.apply_to(spec)
    with caught_warnings() as caught_later, _named(label, text):
        mj_model = spec.compile()
    # Before the compiler's warnings, since this error names the number.
    check_finite(mj_model, label)
    for message in caught + caught_later:
        _refuse_serious(message, mj_model, label, text)
    check_meant(mj_model, label)
    _pass_on(caught + caught_later, label)
    # A trial on the CPU finds features that Warp lacks.
    start_warp()
    with wp.ScopedDevice("cpu"), naming(label):
        warp_model_of(mj_model)
    return mj_model


def _parsed(source: Source) -> tuple[mujoco.MjSpec, str, str, list[str]]:
    """Return the spec, its XML text and its name for messages, and MuJoCo's warnings."""
    # A spec is copied, so that settings do not change the caller's.
    if not isinstance(source, (str, Path)):
        if not isinstance(source, mujoco.MjSpec):
            kind = type(source).__name__
            raise ValueError(
                f"model source is {kind}: expected a path, an XML string, a MjSpec or a menagerie name"
            )
        return source.copy(), "", _labels.get(source, f"model {source.modelname!r}"), []
    read = read_source(source)
    text = read.text
    label = read.label
    if is_urdf(text):
        with naming(label):
            text = ready_urdf(text, read.folder)
    # Before MuJoCo reads the text, which may take minutes or all memory.
    included = check_text(text, read.folder, label)
    with caught_warnings() as caught, _named(label, text):
        if read.path is None:
            spec = mujoco.MjSpec.from_string(text)
        else:
            # MuJoCo knows one suffix only, and is given the text that was checked.
            called = str(read.path.with_suffix(".xml"))
            spec = mujoco.MjSpec.from_file(called, include={**included, called: text.encode()})
    return spec, text, label, caught


@contextmanager
def _named(label: str, text: str) -> Iterator[None]:
    """Name the source and the element in whatever MuJoCo raises."""
    try:
        yield
    except (ValueError, RuntimeError, MemoryError, mujoco.FatalError) as error:
        raise ValueError(_readable(str(error), label, text)) from None


def _readable(message: str, label: str, text: str) -> str:
    """Put MuJoCo's message on one line, with the source and the element."""
    # The prefixes name parts of MuJoCo that a user does not know.
    message = message.strip()
    what = _PREFIXES.sub("", message.splitlines()[0])
    # A parser's error knows the line of the text, but no element.
    if message.startswith("XML parse error"):
        line = _LINE.search(message)
        number = int(line["line"]) if line else 0
        return f"{label}: not well-formed XML{_at_line(text, number)}"
    if found := _ELEMENT.search(message):
        return f"{label}: {what} (element <{found['tag']}>{_at_line(text, int(found['line']))})"
    # The compiler knows elements by name or number, and the line only sometimes.
    if found := _NAMED_ELEMENT.search(message):
        if found["name"]:
            called = f"{found['name']!r}"
        else:
            called = f"number {found['id']} (unnamed)"
        return f"{label}: {what} (element {called}{_at_line(text, int(found['line'] or 0))})"
    # A missing file has no element: the first line that names it is shown.
    if found := _FILE_IN_MESSAGE.search(message):
        lines = [
            number for number, line in enumerate(text.splitlines(), 1) if found["file"] in line
        ]
        return f"{label}: {what}{_at_line(text, lines[0]) if lines else ''}"
    return f"{label}: {what}"


def _at_line(text: str, number: int) -> str:
    lines = text.splitlines()
    if not 1 <= number <= len(lines):
        if number:
            return f", line {number}"
        return ""
    return f", line {number}: {lines[number - 1].strip()[:120]}"


def _refuse_serious(message: str, mj_model: mujoco.MjModel, label: str, text: str) -> None:
    """Refuse models that MuJoCo only warns of, though no simulation of them can be right."""
    # A body or joint without inertia would accelerate without bound.
    if found := _SINGULAR.search(message):
        joint = mj_model.joint(int(mj_model.dof_jntid[int(found["dof"])])).name
        raise ValueError(
            f"{label}: the inertia that joint {joint!r} moves is not positive at the initial pose"
        )
    if "contains a 'NaN'" in message:
        lines = [
            number
            for number, line in enumerate(text.splitlines(), 1)
            if _NAN_ATTRIBUTE.search(line)
        ]
        raise ValueError(f"{label}: a value is NaN{_at_line(text, lines[0]) if lines else ''}")


def _pass_on(caught: list[str], label: str) -> None:
    # The same warning may come from parsing and from compiling.
    for text in dict.fromkeys(caught):
        warnings.warn(f"{label}: {text}", UserWarning, stacklevel=3)


@contextmanager
def caught_warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings, which else go to the terminal and into a file MUJOCO_LOG.TXT."""
    caught: list[str] = []

    def keep(text: bytes | str) -> None:
        caught.append((text.decode(errors="replace") if isinstance(text, bytes) else text).strip())

    # The program's own handler is put back afterwards.
    previous = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(keep)
    try:
        # The bindings warn through Python, besides the C handler.
        with warnings.catch_warnings(record=True) as from_bindings:
            warnings.simplefilter("always")
            yield caught
        for warning in from_bindings:
            keep(str(warning.message))
    finally:
        mujoco.set_mju_user_warning(previous)
