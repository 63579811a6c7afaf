"""Append a sha256 checksum to JSON texts (``run.json``, commit records), and check it when they are read.

A sealed text is a JSON object, or lines that end in one. Its last member is the sha256 of every byte before
it, so that any changed bit is noticed.
"""

from __future__ import annotations

import hashlib
import json
from typing import Any

CHECKSUM = "checksum"
_MARK = f', "{CHECKSUM}": "'
_END = '"}\n'


class SealError(ValueError):
    """An error for a text whose checksum is missing or wrong."""


def seal(text: str, before: bytes = b"") -> str:
    """Append a checksum to a non-empty JSON object; it also covers `before`, the bytes before the object in its
    file.
    """
    body = text.rstrip()
    if not body.endswith("}"):
        raise ValueError("only a JSON object can be sealed.")
    body = body[:-1].rstrip() + _MARK
    return body + hashlib.sha256(before + body.encode()).hexdigest() + _END


def has_seal(content: bytes) -> bool:
    """Return whether a file's content ends with a checksum, right or wrong."""
    return _MARK.encode() in content[-200:]


def fits(content: bytes) -> bool:
    """Return whether the checksum at the end of a file's content fits all bytes before it."""
    n = 64 + len(_END)
    body, end = content[:-n], content[-n:]
    return body.endswith(_MARK.encode()) and end == hashlib.sha256(body).hexdigest().encode() + _END.encode()


def unseal(content: bytes) -> dict[str, Any]:
    """Check the checksum at the end of a JSON object; return the object without it.

    Raises
    ------
    SealError
        If the checksum is missing or does not fit the content.
    """
    if not fits(content):
        raise SealError("its checksum does not fit" if has_seal(content) else "it ends without its checksum")
    data: dict[str, Any] = json.loads(content)
    del data[CHECKSUM]
    return data
