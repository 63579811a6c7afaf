"""What a cube's files declare, held against the plan before anything is decompressed or allocated.

A run directory may come from a stranger, with digests that fit. A few bytes can declare gigabytes of zeros,
metadata can name other codecs or shapes: neither is followed.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numcodecs.blosc
import numpy as np

from pipeline.layout.plan import Plan

METADATA = "zarr.json"
CODECS = (("bytes", "blosc", "crc32c"), ("vlen-utf8", "blosc", "crc32c"))
"""Chains of codecs that cubes are written with: of numbers, and of texts."""

MOST_TEXT = 1_000_000
"""Bytes of an array of texts, such as the names of states."""

_CHECKSUM = 4
_HEADER = 16
"""Bytes of blosc's header; the content's size stands in bytes 4 to 8 of it."""


MOST_PRODUCT_BYTES, MOST_RATIO = 2_000_000_000, 50
"""A product in `derived/` may be so large, or so many times as large as its files."""


def declared_bytes(chunk: Any) -> int:
    """Size that a chunk compressed by blosc declares for its content; -1 if it has no header."""
    header = bytes(memoryview(chunk)[:_HEADER])
    return int.from_bytes(header[4:8], "little") if len(header) == _HEADER else -1


class Declared:
    """What files of the cube may declare.

    Parameters
    ----------
    plan
        Of the run.
    """

    def __init__(self, plan: Plan) -> None:
        self._sizes: Mapping[str, int] = {**dict(zip(plan.dims, plan.shape, strict=True)), **plan.sizes}
        self._variables = {
            v.name: (
                (*plan.shape, *(plan.sizes[d] for d in v.own_dims)),
                plan.chunks(v),
                str(np.dtype(v.dtype)),
            )
            for v in plan.variables
        }
        self._texts: set[str] = set()

    def problem(self, key: str, content: Any) -> str | None:
        """Say what a file declares that it must not; None if nothing."""
        name, _, rest = key.partition("/")
        if not rest:
            return None
        if rest == METADATA:
            return self._metadata_problem(name, bytes(content))
        declared, most = declared_bytes(content), self._most(name)
        exact = name in self._variables
        if not (declared == most or (0 <= declared < most and not exact)):
            return f"declares {declared} bytes, and {'has' if exact else 'may have'} {most}"
        return self._text_problem(bytes(content)) if name in self._texts else None

    def _text_problem(self, content: bytes) -> str | None:
        """Texts begin with their number, for which room is made."""
        number = int.from_bytes(numcodecs.blosc.decompress(content[:-_CHECKSUM])[:4], "little")
        most = max(self._sizes.values(), default=1)
        return None if number <= most else f"declares {number} texts, and may have {most}"

    def _most(self, name: str) -> int:
        """Bytes of a chunk: of a variable just so many, of a coordinate at most."""
        if name in self._variables:
            _, chunk, dtype = self._variables[name]
            return math.prod(chunk) * np.dtype(dtype).itemsize
        # a coordinate lies along one dim of the cube
        return max(MOST_TEXT, 8 * max(self._sizes.values(), default=1))

    def _metadata_problem(self, name: str, content: bytes) -> str | None:
        try:
            data: dict[str, Any] = json.loads(content)
            shape, dims = tuple(data["shape"]), tuple(data.get("dimension_names") or ())
            chunk = tuple(data["chunk_grid"]["configuration"]["chunk_shape"])
            codecs = tuple(codec["name"] for codec in data["codecs"])
            dtype = data["data_type"]
        except (ValueError, KeyError, TypeError, RecursionError):
            return "is no metadata of an array"
        if codecs not in CODECS:
            return _codecs_problem(codecs)
        if codecs == CODECS[1]:
            self._texts.add(name)
        if name in self._variables:
            return (
                None if (shape, chunk, dtype) == self._variables[name] else "has another shape than the plan"
            )
        if shape != tuple(self._sizes.get(dim) for dim in dims) or chunk != tuple(max(n, 1) for n in shape):
            return "has another shape than its dims"
        return None


def _codecs_problem(codecs: tuple[Any, ...]) -> str:
    return f"names the codecs {', '.join(map(str, codecs))[:80]}, with which nothing is written here"


def product_problem(contents: Iterable[tuple[str, bytes]]) -> str | None:
    """Say what the files of a product declare that they must not; None if nothing."""
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
