"""A model that a few words make enormous is refused here, before MuJoCo spends minutes or all memory on it."""

import math
import os
import re
from pathlib import Path

VARIABLE = "KSIM_RL_LARGEST_MODEL"
LARGEST = 10**8

# By a pattern, because it must find the same tags as MuJoCo's parser in what a stricter one refuses.
_TAG = re.compile(r"<!--.*?-->|<(?P<close>/?)(?P<tag>[A-Za-z_]\w*)(?P<rest>[^<>]*?)(?P<alone>/?)>", re.DOTALL)
_ATTRIBUTE = re.compile(r"(\w+)\s*=\s*[\"']([^\"']*)")
# How many numbers an element comes to: the product of these attributes to some power, times what is had of each.
_NUMBERS = {
    "hfield": (("nrow", "ncol"), 1, 1),
    "texture": (("width", "height"), 1, 6),
    "mesh": (("params",), 3, 1),
    "contact": (("num",), 1, 17),
    "user": (("dim",), 1, 1),
    "camera": (("resolution",), 1, 1),
}


def check_text(text: str, folder: Path, label: str) -> None:
    """Refuse an XML text that comes to too much with its replicas, grids and surfaces, and the files it includes."""
    elements, numbers = _count(text, folder, label, ())
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


def _count(text: str, folder: Path, label: str, within: tuple[Path, ...]) -> tuple[int, int]:
    """Return how many elements a text comes to, and how many numbers they have beside."""
    elements = numbers = attachments = user = 0
    largest_model = 0, 0
    times = [1]
    for found in _TAG.finditer(text):
        tag, attributes = found["tag"], dict(_ATTRIBUTE.findall(found["rest"] or ""))
        if tag is None:
            continue
        if found["close"]:
            if tag == "replicate" and len(times) > 1:
                times.pop()
            continue
        elements += times[-1]
        if tag == "replicate" and not found["alone"]:
            times.append(times[-1] * _product(attributes.get("count", "")))
        elif tag == "flexcomp":
            elements += 4 * times[-1] * _product(attributes.get("count", ""))
        elif tag == "attach":
            attachments += times[-1]
        elif tag == "size":
            user += sum(_product(n) for name, n in attributes.items() if name.startswith(("nuser", "nkey")))
        elif tag in _NUMBERS:
            names, power, each = _NUMBERS[tag]
            numbers += each * math.prod(_product(attributes.get(name, "")) for name in names) ** power
        elif tag in ("include", "model") and "file" in attributes:
            path = (folder / attributes["file"]).resolve()
            if path in within:
                raise ValueError(f"{label}: <{tag} file={attributes['file']!r}>: the file takes in itself")
            inner = 0, 0
            if path.is_file():
                inner = _count(path.read_text(errors="replace"), path.parent, label, (*within, path))
            if tag == "model":
                largest_model = max(largest_model, inner)
            else:
                elements, numbers = elements + inner[0] * times[-1], numbers + inner[1]
    elements += attachments * largest_model[0]
    return elements, numbers + attachments * largest_model[1] + user * elements


def _product(text: str) -> int:
    """Return the product of the numbers in a text, those below 1 left out; 1 if it holds anything else."""
    try:
        values = [float(number) for number in text.split()]
    except ValueError:
        return 1
    return math.prod(max(1, int(min(abs(value), 1e18))) for value in values if value == value)
