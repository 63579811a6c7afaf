"""Read MATLAB files up to version 7: numeric arrays, cells, structures."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.rig.recordings.channels import Channel, Raw, digest
from pipeline.specification.problems import SpecError

STEP = "dt"
"""Name of the variable with the sampling interval [s]."""

_HDF5 = b"\x89HDF\r\n\x1a\n"
_PRIVATE = "__"


def read_matlab(path: Path) -> Raw:
    """Read all real arrays of a MATLAB file as channels.

    A variable of one row or column is the channel ``NAME``. The rows of others are ``NAME[0]``, ``NAME[1]``, ...;
    samples lie along the longer side. Fields of a structure are ``STRUCTURE.FIELD``. The elements of cells and of
    structure arrays are stretches: the first elements of all variables form one stretch, the second elements the next.
    A variable that is not a cell belongs to all stretches. A scalar ``dt`` is the sampling interval [s].

    Raise `SpecError` if it is not a MATLAB file, has version 7.3, or its cells differ in number.
    """
    from scipy.io import loadmat

    _refuse_hdf5(path)
    try:
        found = loadmat(path, squeeze_me=False, struct_as_record=True)
    except Exception as error:  # scipy raises what its parser meets: zlib.error, OSError, ValueError, ...
        raise SpecError(f"{path}: is not a MATLAB file that can be read ({error}); save it with -v7.") from None
    leaves: dict[str, list[np.ndarray]] = {}
    for name, value in found.items():
        if not name.startswith(_PRIVATE):
            _gather(name, value, leaves)
    step = _step(leaves)
    stretches = _stretches(path, leaves, step)
    return Raw(path, "matlab", digest(path), stretches, apart=True)


def _refuse_hdf5(path: Path) -> None:
    with path.open("rb") as file:
        head = file.read(520)
    if head.startswith(_HDF5) or head[512:].startswith(_HDF5) or head.startswith(b"MATLAB 7.3"):
        raise SpecError(
            f"{path}: is a MATLAB file of version 7.3 (HDF5), which is not read; "
            "save it again in MATLAB with save(FILE, '-v7'), or write the channels as CSV."
        )


def _gather(name: str, value: Any, leaves: dict[str, list[np.ndarray]]) -> None:
    """Add the numeric arrays of a MATLAB variable to `leaves` by name; fields have entries of their own."""
    if not isinstance(value, np.ndarray):
        return
    if value.dtype.names:
        for field in value.dtype.names:
            _gather(f"{name}.{field}", value[field], leaves)
    elif value.dtype == object and value.size == 1:
        _gather(name, value.flat[0], leaves)
    elif value.dtype == object:
        cells = [_cell(v) for v in value.flat]
        if all(isinstance(c, np.ndarray) and c.dtype.names for c in cells):
            for field in cells[0].dtype.names:
                fields = np.empty(len(cells), dtype=object)
                fields[:] = [_cell(c[field]) if field in (c.dtype.names or ()) else None for c in cells]
                _gather(f"{name}.{field}", fields, leaves)
        elif all(_is_numeric(c) for c in cells):
            leaves[name] = [_plain(c) for c in cells]
    elif _is_numeric(value):
        leaves[name] = [_plain(value)]


def _cell(value: Any) -> Any:
    while isinstance(value, np.ndarray) and value.dtype == object and value.size == 1:
        value = value.flat[0]
    return value


def _is_numeric(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.kind in "fiub" and value.ndim <= 2 and value.size > 0


def _plain(value: np.ndarray) -> np.ndarray:
    return np.atleast_2d(np.asarray(value, dtype=np.float64))


def _step(leaves: dict[str, list[np.ndarray]]) -> float:
    for name, arrays in leaves.items():
        if name.rpartition(".")[2] == STEP and all(a.size == 1 for a in arrays):
            return float(arrays[0].flat[0])
    return math.nan


def _stretches(path: Path, leaves: dict[str, list[np.ndarray]], step: float) -> tuple[dict[str, Channel], ...]:
    counts = {name: len(arrays) for name, arrays in leaves.items() if len(arrays) > 1}
    if len(set(counts.values())) > 1:
        told = ", ".join(f"{name} has {n}" for name, n in counts.items())
        raise SpecError(f"{path}: cells are the pieces of one recording, but {told}; save equally many of each.")
    n = max(counts.values(), default=1)
    return tuple(
        {
            channel.name: channel
            for name, arrays in leaves.items()
            for channel in _channels(name, arrays[i if len(arrays) > 1 else 0], step)
        }
        for i in range(n)
    )


def _channels(name: str, array: np.ndarray, step: float) -> list[Channel]:
    """Convert an array to channels. The samples of each channel lie along the longer dimension of the array."""
    rows = array if array.shape[1] >= array.shape[0] else array.T
    if rows.shape[1] == 1:
        return []
    if rows.shape[0] == 1:
        return [Channel(name, rows[0], step_s=step)]
    return [Channel(f"{name}[{i}]", row, step_s=step) for i, row in enumerate(rows)]
