"""Decodes XML as its first bytes say: byte order mark, or declared encoding, else UTF-8."""

import codecs
import re

# The longer marks first: UTF-32's begins with UTF-16's.
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_DECLARED = re.compile(rb"\s*<\?xml\b[^>]*?\bencoding\s*=\s*[\"']([A-Za-z0-9._-]+)[\"']")


def decode_xml(data: bytes) -> str:
    """Return the text of an XML file; a ValueError names the encoding and the first byte that is not of it."""
    encoding = _encoding(data)
    try:
        return data.decode(encoding)
    except LookupError:
        raise ValueError(f"its encoding {encoding!r} is not known: save it as UTF-8") from None
    except UnicodeDecodeError as error:
        name = "UTF-8" if encoding == "utf-8" else encoding
        raise ValueError(
            f"is not {name} text: byte {error.start}; save it as UTF-8, or declare its encoding in the first line: "
            '<?xml version="1.0" encoding="..."?>'
        ) from None
    except UnicodeError as error:  # of encodings that are cut short
        raise ValueError(f"is not {encoding} text: {error}; save it as UTF-8") from None


def _encoding(data: bytes) -> str:
    for mark, encoding in _MARKS:
        if data.startswith(mark):
            return encoding
    declared = _DECLARED.match(data)
    if declared:
        return declared[1].decode()
    return "utf-8"
