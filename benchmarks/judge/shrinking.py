"""Makes a failing model small: parts are left out until it needs all that remain."""

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Sequence

Fails = Callable[[str, tuple[str, ...]], bool]
# What stays: the frame of a model, and what gives an element its kind.
_KEPT_ELEMENTS = ("mujoco", "worldbody", "compiler", "option")
_KEPT_ATTRIBUTES = ("name", "type", "class")


def shrunk(
    xml: str, fields: Sequence[str], fails: Fails, *, most_trials: int = 80
) -> tuple[str, tuple[str, ...]]:
    """Return the smallest model and fields found that still fail, in at most so many trials.

    Args:
        xml: a model that fails.
        fields: in which its worlds differ.
        fails: whether a model fails in the same way; a model that cannot be compiled does not.
        most_trials: of them.
    """
    left = [most_trials]

    def still_fails(candidate: str, with_fields: tuple[str, ...]) -> bool:
        if left[0] <= 0:
            return False
        left[0] -= 1
        return fails(candidate, with_fields)

    kept = tuple(fields)
    if kept and still_fails(xml, ()):
        kept = ()
    for field in tuple(kept) if len(kept) > 1 else ():
        others = tuple(name for name in kept if name != field)
        if still_fails(xml, others):
            kept = others
    is_smaller = True
    while is_smaller and left[0] > 0:
        is_smaller = False
        for candidates in (without_elements, without_attributes):
            smaller = _first_to_last(
                xml, candidates, lambda candidate: still_fails(candidate, kept)
            )
            is_smaller |= smaller != xml
            xml = smaller
    return xml, kept


def _first_to_last(
    xml: str, candidates: Callable[[str], Iterator[str]], fails: Callable[[str], bool]
) -> str:
    """Return what is left of a model when each candidate in turn is taken if it fails."""
    place = 0
    while True:
        found = list(candidates(xml))
        if place >= len(found):
            return xml
        if fails(found[place]):
            # The next one is now at the same place.
            xml = found[place]
        else:
            place += 1


def without_elements(xml: str) -> Iterator[str]:
    """Yield a model without each of its elements, the largest first: sections, bodies, and what is in them."""
    count = len(list(ET.fromstring(xml).iter()))
    sizes = [len(list(element.iter())) for element in ET.fromstring(xml).iter()]
    for place in sorted(range(1, count), key=lambda place: -sizes[place]):
        root = ET.fromstring(xml)
        element = list(root.iter())[place]
        if element.tag in _KEPT_ELEMENTS:
            continue
        above = next(parent for parent in root.iter() if element in list(parent))
        above.remove(element)
        yield ET.tostring(root, encoding="unicode")


def without_attributes(xml: str) -> Iterator[str]:
    """Yield a model without each of its attributes."""
    for place, element in enumerate(ET.fromstring(xml).iter()):
        for name in element.attrib:
            if name in _KEPT_ATTRIBUTES or element.tag == "compiler":
                continue
            root = ET.fromstring(xml)
            del list(root.iter())[place].attrib[name]
            yield ET.tostring(root, encoding="unicode")
