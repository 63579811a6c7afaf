"""Check what files of arrays declare before anything is decompressed or allocated.

A run directory may come from a stranger, with digests that fit. A few bytes can declare gigabytes of zeros, and
metadata can name other codecs or shapes. Both are refused.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from pipeline.layout.plan import Plan

METADATA = "zarr.json"
CODECS = (("bytes", "blosc", "crc32c"), ("vlen-utf8", "blosc", "crc32c"))
"""Codecs that cubes are written with: one chain for numbers, one for texts."""

MOST_TEXT = 1_000_000
"""Most bytes of an array of texts, such as the names of states."""

_CHECKSUM = 4
_HEADER = 16
"""Bytes of blosc's header. Its bytes 4 to 8 hold the size of the content."""


MOST_PRODUCT_BYTES, MOST_RATIO = 2_000_000_000, 50
"""Most bytes that a product in `derived/` may declare, or most bytes per byte on disk, whichever is more."""


def declared_bytes(chunk: Any) -> int:
    """Return the uncompressed size in the header of a blosc chunk; -1 if there is no header."""
    header = bytes(memoryview(chunk)[:_HEADER])
    return int.from_bytes(header[4:8], "little") if len(header) == _HEADER else -1


class Declared:
    """Checks of a result cube's files: the sizes, shapes and codecs that they declare must fit the run's plan."""

    def __init__(self, plan: Plan) -> None:
        self._sizes: Mapping[str, int] = {**dict(zip(plan.dims, plan.shape, strict=True)), **plan.sizes}
        self._variables = {
            v.name: ((*plan.shape, *(plan.sizes[d] for d in v.own_dims)), plan.chunks(v), str(np.dtype(v.dtype)))
            for v in plan.variables
        }
        self._texts: set[str] = set()

    def problem(self, key: str, content: Any) -> str | None:
        """Check the size, shape and codecs that a file declares against the plan; return the problem, or None."""
        name, _, rest = key.partition("/")
        if not rest:
            return self._group_problem(bytes(content)) if name == METADATA else None
        if rest == METADATA:
            return self._metadata_problem(name, _parsed(content))
        declared, most = declared_bytes(content), self._most(name)
        exact = name in self._variables
        if not (declared == most or (0 <= declared < most and not exact)):
            return f"declares {declared} bytes, and {'has' if exact else 'may have'} {most}"
        return self._text_problem(bytes(content)) if name in self._texts else None

    def _group_problem(self, content: bytes) -> str | None:
        """Check the metadata of arrays that the group's file repeats; return the first problem, or None."""
        for name, metadata in consolidated_metadata(content).items():
            if problem := self._metadata_problem(name, metadata):
                return f"its metadata of {name}: {problem}"
        return None

    def _text_problem(self, content: bytes) -> str | None:
        """Check the number of texts that a chunk declares, as decoding allocates memory for it."""
        import numcodecs.blosc

        number = int.from_bytes(numcodecs.blosc.decompress(content[:-_CHECKSUM])[:4], "little")
        most = max(self._sizes.values(), default=1)
        return None if number <= most else f"declares {number} texts, and may have {most}"

    def _most(self, name: str) -> int:
        """Return the allowed size of a chunk [bytes]: exact for a variable, a bound for a coordinate."""
        if name in self._variables:
            _, chunk, dtype = self._variables[name]
            return math.prod(chunk) * np.dtype(dtype).itemsize
        # a coordinate lies along one dim of the cube
        return max(MOST_TEXT, 8 * max(self._sizes.values(), default=1))

    def _metadata_problem(self, name: str, data: Any) -> str | None:
        try:
            shape, dims = tuple(data["shape"]), tuple(data.get("dimension_names") or ())
            chunk = tuple(data["chunk_grid"]["configuration"]["chunk_shape"])
            codecs = tuple(codec["name"] for codec in data["codecs"])
            dtype = data["data_type"]
        except (ValueError, KeyError, TypeError):
            return "is no metadata of an array"
        if codecs not in CODECS:
            return _codecs_problem(codecs)
        if codecs == CODECS[1]:
            self._texts.add(name)
        if name in self._variables:
            return None if (shape, chunk, dtype) == self._variables[name] else "has another shape than the plan"
        if shape != tuple(self._sizes.get(dim) for dim in dims) or chunk != tuple(max(n, 1) for n in shape):
            return "has another shape than its dims"
        return None


def _parsed(content: Any) -> Any:
    """Return the data in a text of JSON; None for a text that is none."""
    try:
        return json.loads(bytes(content))
    except (ValueError, RecursionError):
        return None


def consolidated_metadata(group: bytes) -> dict[str, Any]:
    """Return the metadata of all arrays, by name, that a group's ``zarr.json`` repeats; empty if it repeats none."""
    try:
        found = _parsed(group)["consolidated_metadata"]["metadata"]
    except (KeyError, TypeError):
        return {}
    return found if isinstance(found, dict) else {}


def disagreements(contents: Mapping[str, bytes]) -> list[str]:
    """Return a line for each array whose metadata differ from their copy in the group's ``zarr.json``, by contents of
    files.

    A group without copies has no problem: earlier versions of magpend have made such groups. Arrays without a
    ``zarr.json`` among the files are not compared.
    """
    copies = consolidated_metadata(contents.get(METADATA, b""))
    own = {key.rpartition("/")[0]: content for key, content in contents.items() if key.endswith(f"/{METADATA}")}
    found = []
    for name, content in own.items() if copies else ():
        if name not in copies or _parsed(content) != copies[name]:
            found.append(f"{METADATA}: its metadata of {name} are not those of {name}/{METADATA}")
    return found


def _codecs_problem(codecs: tuple[Any, ...]) -> str:
    return f"names the codecs {', '.join(map(str, codecs))[:80]}, with which nothing is written here"


def product_problem(contents: Iterable[tuple[str, bytes]]) -> str | None:
    """Check the sizes and codecs that a stored result's files declare; return the first problem, or None."""
    chunk_bytes: dict[str, int] = {}
    total, on_disk = 0, 0
    chunks: list[tuple[str, int]] = []
    for key, content in contents:
        name, _, rest = key.partition("/")
        if rest == METADATA:
            try:
                data = json.loads(content)
                codecs = tuple(codec["name"] for codec in data["codecs"])
                shape, chunk = data["shape"], data["chunk_grid"]["configuration"]["chunk_shape"]
                itemsize = np.dtype(data["data_type"]).itemsize
                n_chunks = math.prod(-(-n // c) for n, c in zip(shape, chunk, strict=True))
            except (ValueError, KeyError, TypeError, ZeroDivisionError, RecursionError):
                return f"{name}: is no metadata of an array"
            if codecs != CODECS[0]:
                return f"{name}: {_codecs_problem(codecs)}"
            chunk_bytes[name] = math.prod(chunk) * itemsize
            total += n_chunks * chunk_bytes[name]
        elif rest:
            chunks.append((name, declared_bytes(content)))
            on_disk += len(content)
    for name, declared in chunks:
        if declared != chunk_bytes.get(name):
            return f"{name}: a chunk declares {declared} bytes, and has {chunk_bytes.get(name, 0)}"
    if total > max(MOST_PRODUCT_BYTES, MOST_RATIO * on_disk):
        return f"declares {total} bytes in {on_disk}"
    return None
