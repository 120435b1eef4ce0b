"""Checks messages of the viewer's page before viser takes them: a message it sends, with a value that its control has.

viser lets a client set any property of a widget to anything, open a tunnel to other machines, and upload files.
"""

import math
from collections.abc import Mapping
from typing import Any

import msgspec
import viser

CAMERA = "ViewerCameraMessage"
UPDATE = "GuiUpdateMessage"
# Bytes of a message; the longest that the page sends has a few hundred.
MOST_BYTES = 16 * 1024
_MOST_NUMBERS = 4


def checked(raw: str | bytes, widgets: Mapping[str, Any]) -> bytes | None:
    """Return a message as viser may have it, with its number clamped to the widget's range, or None for any other.

    `widgets` are viser's handles by the identifier that its messages have.
    """
    # viser's messages are binary.
    if not isinstance(raw, bytes):
        return None
    try:
        message = msgspec.msgpack.decode(raw)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return None
    if not isinstance(message, dict):
        return None
    kind = message.get("type")
    # The camera of the page has numbers only.
    if kind == CAMERA:
        entries = [entry for name, entry in message.items() if name != "type"]
        if all(map(_is_pose, entries)):
            return raw
        return None
    # Exactly these fields: others would reach code of viser unchecked.
    if kind != UPDATE or message.keys() != {"type", "uuid", "updates"}:
        return None
    uuid = message["uuid"]
    updates = message["updates"]
    if not isinstance(uuid, str) or not isinstance(updates, dict) or updates.keys() != {"value"}:
        return None
    # Only values that the widget itself could send.
    value = _allowed(updates["value"], widgets.get(uuid))
    if value is None:
        return None
    # Packed again, so that nothing else of the message gets through.
    return msgspec.msgpack.encode({"type": UPDATE, "uuid": uuid, "updates": {"value": value}})


def clamped(value: float, low: float | None, high: float | None) -> float:
    """Return the number of a range that is nearest to `value`; None is no bound."""
    if low is not None:
        value = max(low, value)
    if high is None:
        return value
    return min(high, value)


def is_number(value: object) -> bool:
    """Whether it is a finite number, which a truth value is not."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number that no float holds
        return False


def _is_pose(entry: object) -> bool:
    if isinstance(entry, list | tuple):
        return len(entry) <= _MOST_NUMBERS and all(map(is_number, entry))
    return is_number(entry)


def _allowed(value: Any, widget: Any) -> Any:
    """Return the value that a widget may take for the one that a page has sent, or None."""
    # The widgets that the panel has; all others are refused.
    if isinstance(widget, viser.GuiButtonHandle | viser.GuiCheckboxHandle):
        if isinstance(value, bool):
            return value
        return None
    if isinstance(widget, viser.GuiDropdownHandle | viser.GuiButtonGroupHandle):
        if isinstance(value, str) and value in widget.options:
            return value
        return None
    if isinstance(widget, viser.GuiSliderHandle | viser.GuiNumberHandle):
        if is_number(value):
            return clamped(value, widget.min, widget.max)
        return None
    return None
