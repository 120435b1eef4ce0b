"""A model that a few words make enormous is refused here, before MuJoCo spends minutes or all memory on it."""

import codecs
import html
import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from ksim_rl.checks import naming
from ksim_rl.files.reading import MOST_DATA_BYTES, MOST_MODEL_BYTES, check_regular, read_bytes
from ksim_rl.files.xml_text import decode_xml

VARIABLE = "KSIM_RL_LARGEST_MODEL"
LARGEST = 10**8

# By a pattern, because it must find the same tags as MuJoCo's parser in what a stricter one refuses. Comments, text as
# it is, instructions and declarations come first, since words in them are no tags; brackets in quotes end no tag.
_TAG = re.compile(
    r"<!--.*?-->|<!\[CDATA\[.*?\]\]>|<\?.*?\?>|<![^>]*>"
    r"|<(?P<close>/?)(?P<tag>[A-Za-z_][\w:.-]*)(?P<rest>(?:[^<>\"']|\"[^\"]*\"|'[^']*')*?)(?P<alone>/?)>",
    re.DOTALL,
)
_ATTRIBUTE = re.compile(r"([\w:.-]+)\s*=\s*(?:\"([^\"]*)\"|'([^']*)')")
_FOLDERS = ("meshdir", "texturedir", "assetdir")
MOST_FOLDERS = 16
# How many numbers an element comes to: the product of these attributes to some power, times what is had of each.
_NUMBERS = {
    "hfield": (("nrow", "ncol"), 1, 1),
    "texture": (("width", "height"), 1, 6),
    "mesh": (("params",), 3, 1),
    "contact": (("num",), 1, 17),
    "user": (("dim",), 1, 1),
    "camera": (("resolution",), 1, 1),
}


@dataclass
class _Files:
    """The files that a model takes in, each counted once, and those that it names for MuJoCo to read."""

    label: str
    folder: Path  # of the model itself
    counts: dict[Path, tuple[int, int]] = field(default_factory=dict)
    folders: set[Path] = field(default_factory=set)
    # Folders of assets, as any of the texts has them.
    below: set[str] = field(default_factory=lambda: {""})
    named: set[str] = field(default_factory=set)
    included: list[Path] = field(default_factory=list)
    # UTF-8, by the path under which MuJoCo looks.
    recoded: dict[str, bytes] = field(default_factory=dict)

    def text(self, path: Path, called: str) -> str:
        """Read a file that is included or attached, which MuJoCo looks for under `called`."""
        with naming(self.label):
            data = read_bytes(path, limit=MOST_MODEL_BYTES, follows_links=True)
        with naming(f"{self.label}: included file {str(path)!r}"):
            text = decode_xml(data)
        # MuJoCo reads UTF-8 only: other encodings are handed over as UTF-8.
        if text.encode() not in (data, data.removeprefix(codecs.BOM_UTF8)):
            self.recoded[called] = text.encode()
        return text

    def assets(self) -> Iterator[Path]:
        """Yield the files of meshes, pictures and height fields that the texts name, and that are there."""
        # Which folder belongs to which name depends on the order of texts; so each is tried with each.
        for start in sorted({self.folder, *self.folders}):
            for below in sorted(self.below):
                for name in sorted(self.named):
                    path = start / below / name
                    if os.path.exists(path) and not path.is_dir():
                        yield path

    def check_assets(self) -> None:
        """Refuse pipes and devices, at which MuJoCo would wait or never end, and files that are too large."""
        # Every name is tried in every folder, so that their number is bounded, too.
        if len(self.below) > MOST_FOLDERS:
            raise ValueError(
                f"{self.label}: {len(self.below)} folders of assets: expected {MOST_FOLDERS} at most"
            )
        for path in self.assets():
            with naming(self.label):
                check_regular(path, limit=MOST_DATA_BYTES)


def check_text(text: str, folder: Path, label: str) -> dict[str, bytes]:
    """Refuse an XML text that grows too large by its replicas, grids and surfaces, or by the files that it includes.

    Files that it names, of meshes, pictures and height fields too, must be regular ones of limited size.
    Return the included files that MuJoCo cannot decode, as UTF-8, by the path under which it looks for them.
    """
    read = _Files(label=label, folder=folder)
    elements, numbers = _count(text, folder, read, ())
    read.check_assets()
    check_size(elements, numbers, label)
    return read.recoded


def check_size(elements: int, numbers: float, label: str) -> None:
    """Refuse a model of so many elements, which beside themselves have so many numbers; `label` says where it is."""
    given = os.environ.get(VARIABLE, str(LARGEST))
    if not given.isdecimal():
        raise ValueError(f"{VARIABLE}={given!r}: expected a whole number")
    # MuJoCo compares elements with each other.
    if (most := max(elements**2, numbers)) > int(given):
        raise ValueError(
            f"{label}: {elements:,} elements and {numbers:,} numbers of surfaces, sensors and user data, which MuJoCo "
            "would spend minutes or all memory on: make it smaller, or raise the environment variable "
            f"{VARIABLE} to {most}, the larger of the elements squared and the numbers (now {given})"
        )


def files_named(text: str, folder: Path, label: str) -> list[Path]:
    """Return the files that a text includes, attaches or names, each once, by absolute paths with links in them."""
    read = _Files(label=label, folder=folder)
    _count(text, folder, read, ())
    read.check_assets()
    found = [*read.included, *read.assets()]
    return sorted({Path(os.path.abspath(path)) for path in found})


def _count(text: str, folder: Path, read: _Files, within: tuple[Path, ...]) -> tuple[int, int]:
    """Return how many elements a text comes to, and how many numbers they have beside."""
    elements = numbers = attachments = user = 0
    largest_model = 0, 0
    # How often the present element is there: a stack, since replicates nest.
    times = [1]
    read.folders.add(folder)
    for found in _TAG.finditer(text):
        tag = found["tag"]
        attributes = _attributes(found["rest"] or "")
        if tag is None:
            continue
        # Names are collected from all elements, since MuJoCo resolves them later.
        read.below |= {attributes[name] for name in _FOLDERS if name in attributes}
        read.named |= {value for name, value in attributes.items() if name.startswith("file")}
        if found["close"]:
            if tag == "replicate" and len(times) > 1:
                times.pop()
            continue
        # A body within replicates counts once for each.
        elements += times[-1]
        if tag == "replicate" and not found["alone"]:
            times.append(times[-1] * _product(attributes.get("count", "")))
        # A flexcomp makes several elements for each of its points.
        elif tag == "flexcomp":
            elements += 4 * times[-1] * _product(attributes.get("count", ""))
        elif tag == "attach":
            attachments += times[-1]
        # Each element of the model may hold so much user data.
        elif tag == "size":
            user += sum(
                _product(n) for name, n in attributes.items() if name.startswith(("nuser", "nkey"))
            )
        elif tag in _NUMBERS:
            names, power, each = _NUMBERS[tag]
            numbers += (
                each * math.prod(_product(attributes.get(name, "")) for name in names) ** power
            )
        elif tag in ("include", "model") and "file" in attributes:
            # Resolved, so that a circle through links is found.
            path = (folder / attributes["file"]).resolve()
            if path in within:
                raise ValueError(
                    f"{read.label}: <{tag} file={attributes['file']!r}>: the file takes in itself"
                )
            if path not in read.counts:
                # Anything but a file, such as a pipe, is refused; MuJoCo names a missing file with its line.
                read.counts[path] = 0, 0
                if path.exists():
                    read.included.append(folder / attributes["file"])
                    included = read.text(path, str(folder / attributes["file"]))
                    read.counts[path] = _count(included, path.parent, read, (*within, path))
            inner = read.counts[path]
            # Which model an <attach> takes is not known here: the largest one is counted.
            if tag == "model":
                largest_model = max(largest_model, inner)
            else:
                elements = elements + inner[0] * times[-1]
                numbers = numbers + inner[1]
    elements += attachments * largest_model[0]
    return elements, numbers + attachments * largest_model[1] + user * elements


def _attributes(text: str) -> dict[str, str]:
    """Return attributes with their values as a parser of XML reads them; of those that are there twice, the first."""
    found: dict[str, str] = {}
    for name, double, single in _ATTRIBUTE.findall(text):
        found.setdefault(name, html.unescape(double or single))
    return found


def _product(text: str) -> int:
    """Return the product of the numbers in a text, those below 1 left out; 1 if it holds anything else."""
    try:
        values = [float(number) for number in text.split()]
    except ValueError:
        return 1
    # Bounded, so that a product of such numbers ends; NaN differs from itself.
    return math.prod(max(1, int(min(abs(value), 1e18))) for value in values if value == value)
