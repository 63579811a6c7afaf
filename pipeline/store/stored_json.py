"""Seal JSON texts (``run.json``, commit records, packs) by a checksum; check it, and the types of their values.

A sealed text is a JSON object, or lines that end in one. Its last member is the sha256 of every byte before
it, so that any changed bit is noticed.
"""

from __future__ import annotations

import hashlib
import json
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, Field, ValidationError

from magpend_core.models.parameters import has_controls
from pipeline.products.product import STRICT
from pipeline.specification.problems import problems_of
from pipeline.store.declared import METADATA

# ---- checksums -------------------------------------------------------------------------------------

CHECKSUM = "checksum"
_MARK = f', "{CHECKSUM}": "'
_END = '"}\n'


class SealError(ValueError):
    """An error for a text whose checksum is missing or wrong."""


def seal(text: str, before: bytes = b"") -> str:
    """Append a checksum to a JSON object; it also covers `before`, the bytes before it in its file."""
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
    """Check the checksum at the end of a JSON object; return the object without it, or raise `SealError`."""
    if not fits(content):
        raise SealError("its checksum does not fit" if has_seal(content) else "it ends without its checksum")
    data: dict[str, Any] = json.loads(content)
    del data[CHECKSUM]
    return data


# ---- types -----------------------------------------------------------------------------------------


class Stored(BaseModel):
    """A stored object: its keys are all there, no others are, and each value has its type."""

    model_config = STRICT


S = TypeVar("S", bound=Stored)


def _key(text: str) -> str:
    parts = text.split("/")
    if not text.isprintable() or ".." in parts or "" in parts:  # a key must not lead out of the run directory
        raise ValueError("is not the path of a file in the cube")
    return text


def _group_first(entries: dict[str, Any]) -> dict[str, Any]:
    if METADATA not in entries:
        raise ValueError(f"has no {METADATA}")
    return entries


def _printable(text: str) -> str:
    if has_controls(text):
        raise ValueError("has control characters")
    return text


Line = Annotated[str, AfterValidator(_printable)]
Count = Annotated[int, Field(ge=0, lt=2**63)]
CellCounts = dict[Annotated[str, Field(pattern="^[a-z_]+$")], Count]


class Entry(Stored):
    """Size and sha256 of a file."""

    size: Count
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


Entries = dict[Annotated[str, AfterValidator(_key)], Entry]


class StoredCommit(Stored):
    """A commit record: its run's digest, its task, cells by status, and the task's files by key below the cube."""

    digest: str
    task: Count
    status: CellCounts
    objects: Entries


class StoredPack(Stored):
    """The last line of a pack of commit records."""

    block: Count
    cells: CellCounts
    digest: str
    without: list[Count]


class StoredIdentity(Stored):
    """Identity of a run: the entries that decide its numbers and layout."""

    refinement: int | None = None
    format: int | float
    versions: dict[str, Count] | None = None
    kernel_version: str | None = None
    code: dict[str, str] | None = None
    spec: dict[str, Any]
    model_digest: str
    parameter_values: dict[str, int | float]
    coordinates: str
    chunks: dict[str, list[Count]]


class StoredRun(Stored):
    """The content of ``run.json``."""

    digest: str
    identity: StoredIdentity
    title: Line
    spec: dict[str, Any]
    spec_text: str
    versions: dict[Line, Line]
    provenance: dict[Line, Line]
    skeleton: Annotated[Entries, AfterValidator(_group_first)]


class WrongTypeError(ValueError):
    """An error for stored JSON of other types; its message names the first key."""


def parsed(model: type[S], data: Any) -> dict[str, Any]:
    """Compare stored JSON with its types; return it as plain data, or raise `WrongTypeError`."""
    try:
        return model.model_validate(data).model_dump(exclude_unset=True)
    except ValidationError as error:
        raise WrongTypeError(problems_of(error, model, "")[0]) from None
