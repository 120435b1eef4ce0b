"""The checksum of Unitree's commands: CRC-32/MPEG-2 of the words of the C struct, each with its highest byte first."""

import dataclasses
import struct
import zlib
from array import array

_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def crc32_mpeg2(data: bytes) -> int:
    """Return CRC-32/MPEG-2: the polynomial of zlib's CRC-32, with the highest bit first and no inversion at the end."""
    found = zlib.crc32(data.translate(_REVERSED)) ^ 0xFFFFFFFF
    return int(f"{found:032b}"[::-1], 2)


def checksum(message, layout: str) -> int:
    """Return the checksum of a message, whose last field is the checksum; `layout` is its C struct for `struct`."""
    content = struct.pack(layout, *_numbers(message))
    words = array("I", content[:-4])
    words.byteswap()
    return crc32_mpeg2(words.tobytes())


def _numbers(value):
    """Return all numbers of a message in the order of its fields."""
    if dataclasses.is_dataclass(value):
        parts = [getattr(value, field.name) for field in dataclasses.fields(value)]
    elif isinstance(value, (list, tuple, bytes)):
        parts = list(value)
    else:
        return [value]
    found = []
    for part in parts:
        found += _numbers(part)
    return found
