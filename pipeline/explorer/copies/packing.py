"""Pack the data of an exported page: arrays or JSON, compressed by gzip.

Bytes of numbers lie apart, all first bytes before all second ones, which gzip makes a third smaller.
`page/src/export-data.js` is the other end.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.explorer.data.arrays import pack_arrays

LEVEL = 6
"""Of gzip: beyond it, data of this kind shrink by less than a percent."""


def packed(arrays: Mapping[str, np.ndarray], attrs: Mapping[str, Any] | None = None) -> bytes:
    """Return arrays and attributes as gzip bytes.

    Parameters
    ----------
    arrays
        Arrays by name, of a type in `pipeline.explorer.data.arrays.DTYPES`.
    attrs
        Values that JSON can store.

    Raises
    ------
    ValueError
        As `pack_arrays`.
    """
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


def packed_json(value: Any) -> bytes:
    """Return a JSON value as gzip bytes; raise `ValueError` for NaN or infinity."""
    return _zipped(json.dumps(value, allow_nan=False, separators=(",", ":")).encode())


def _zipped(content: bytes) -> bytes:
    # no time stamp, so that equal content gives equal bytes
    return gzip.compress(content, LEVEL, mtime=0)
