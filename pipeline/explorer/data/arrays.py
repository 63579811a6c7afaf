"""Pack arrays into one byte string that the script of the page reads without copying.

A little-endian uint32 says how long the header is; the header is JSON in UTF-8, padded with spaces so that
what follows begins at a multiple of 8; then come the arrays in C order, each padded to 8 bytes::

    {"attrs": {...}, "arrays": {"y": {"dtype": "float64", "shape": [3, 2], "offset": 0}, ...}}

Offsets count from the end of the header. `page/src/arrays.js` is the other end, and `page/src/export-data.js` that
of the zipped objects of an exported page.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

DTYPES = ("float64", "float32", "int32", "uint32", "int16", "uint16", "int8", "uint8")
"""What a browser has typed arrays for; 64-bit integers are not among them."""


def _padding(length: int) -> int:
    alignment = 8
    return -length % alignment


def pack_arrays(arrays: Mapping[str, np.ndarray], attrs: Mapping[str, Any] | None = None) -> bytes:
    """Pack arrays, of a type in `DTYPES`, and attributes that JSON can store into one byte string.

    NaN and infinity are no attributes; None stands for a missing value. Raise ValueError for what cannot be packed.
    """
    places: dict[str, Any] = {}
    parts: list[Any] = []
    offset = 0
    for name, values in arrays.items():
        if values.dtype.name not in DTYPES:
            raise ValueError(f"array {name} is of type {values.dtype}: one of {', '.join(DTYPES)} is needed")
        # join without copies, which would double the memory of a large diagram
        data = np.ascontiguousarray(values, values.dtype.newbyteorder("<")).reshape(-1).view(np.uint8)
        places[name] = {"dtype": values.dtype.name, "shape": list(values.shape), "offset": offset}
        parts += [data, bytes(_padding(len(data)))]
        offset += len(data) + _padding(len(data))
    header = json.dumps({"attrs": dict(attrs or {}), "arrays": places}, allow_nan=False).encode()
    header += b" " * _padding(len(header) + 4)
    return b"".join([len(header).to_bytes(4, "little"), header, *parts])


def unpack_arrays(data: bytes) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read the arrays and attributes from a byte string that `pack_arrays` made."""
    begin = 4 + int.from_bytes(data[:4], "little")
    header = json.loads(data[4:begin])
    arrays = {}
    for name, place in header["arrays"].items():
        shape = tuple(place["shape"])
        dtype = np.dtype(place["dtype"]).newbyteorder("<")
        count = int(np.prod(shape, dtype=np.int64))
        arrays[name] = np.frombuffer(data, dtype, count, begin + place["offset"]).reshape(shape)
    return arrays, header["attrs"]


def pack_zipped(arrays: Mapping[str, np.ndarray], attrs: Mapping[str, Any] | None = None) -> bytes:
    """Pack arrays and attributes as `pack_arrays` does, and compress them by gzip."""
    apart: dict[str, dict[str, Any]] = {}
    stored = {}
    for name, values in arrays.items():
        stored[name] = values
        if values.dtype.itemsize > 1:
            apart[name] = {"dtype": values.dtype.name, "shape": list(values.shape)}
            plain = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
            planes = plain.reshape(-1).view(np.uint8).reshape(-1, values.dtype.itemsize)
            stored[name] = np.ascontiguousarray(planes.T)
    return _zipped(pack_arrays(stored, {**(attrs or {}), "apart": apart}))


def zip_json(value: Any) -> bytes:
    """Pack a JSON value into gzip-compressed bytes; ValueError if it has NaN or infinity."""
    return _zipped(json.dumps(value, allow_nan=False, separators=(",", ":")).encode())


def _zipped(content: bytes) -> bytes:
    level = 6  # beyond it, data of this kind shrink by less than a percent
    # no time stamp, so that equal content gives equal bytes
    return gzip.compress(content, level, mtime=0)
