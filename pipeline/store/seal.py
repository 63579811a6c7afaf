"""Texts under a checksum of their own: ``run.json``, commit records and packs of these.

A sealed text is a JSON object (or lines that end in one) whose last member is the sha256 of every byte
before it, so that no bit of it can change without being noticed.
"""

from __future__ import annotations

import hashlib
import json
from typing import Any

CHECKSUM = "checksum"
_MARK = f', "{CHECKSUM}": "'
_END = '"}\n'


class SealError(ValueError):
    """A text is not what was sealed; the message says how it can be seen."""


def seal(text: str, before: bytes = b"") -> str:
    """Append the checksum to a JSON object that is not empty; `before` is what precedes it in its file."""
    body = text.rstrip()
    if not body.endswith("}"):
        raise ValueError("only a JSON object can be sealed.")
    body = body[:-1].rstrip() + _MARK
    return body + hashlib.sha256(before + body.encode()).hexdigest() + _END


def has_seal(content: bytes) -> bool:
    """Whether a content names a checksum at its end, fitting or not."""
    return _MARK.encode() in content[-200:]


def fits(content: bytes) -> bool:
    """Whether a content is, byte for byte, what was sealed."""
    n = 64 + len(_END)
    body, end = content[:-n], content[-n:]
    return body.endswith(_MARK.encode()) and end == hashlib.sha256(body).hexdigest().encode() + _END.encode()


def unseal(content: bytes) -> dict[str, Any]:
    """Return the data of a sealed JSON object, without the checksum.

    Raises
    ------
    SealError
        If the content is not what was sealed.
    """
    if not fits(content):
        raise SealError("its checksum does not fit" if has_seal(content) else "it ends without its checksum")
    data: dict[str, Any] = json.loads(content)
    del data[CHECKSUM]
    return data
