"""Define when two runs are the same: compute a run's identity and its digest, and list the differences between two
identities.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from magpend_core.versions import ENGINE
from pipeline.layout.cells import coordinates
from pipeline.layout.schema import FORMAT, REFINEMENT
from pipeline.products.registry import CELL_PRODUCTS
from pipeline.specification.spec import Spec

CELLS = 1
"""Number of what turns a specification into cells: inputs, motions, refined grids. See `magpend_core.versions`."""


def identity_of(spec: Spec, chunks: Mapping[str, tuple[int, ...]]) -> dict[str, Any]:
    """Return all data that determine the bytes of a run's store: specification, parameters, layout, versions.

    The title, the source of a function and ``[execution]`` are left out; the chunks that follow from ``[execution]``
    are included. So is a digest of the coordinates, the numbers that ranges and seeds stand for.
    """
    return {
        **({} if spec.refine is None else {"refinement": REFINEMENT}),
        "format": FORMAT,
        "versions": versions_of(spec),
        "spec": identity_tables(spec.as_dict()),
        "model_digest": spec.model.digest,
        "parameter_values": spec.values.as_dict(),
        "coordinates": _coordinates_digest(spec),
        "chunks": {name: list(chunk) for name, chunk in chunks.items()},
    }


def identity_tables(tables: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables of a specification, as plain data, that belong to a run's identity."""
    found = {k: v for k, v in tables.items() if k not in ("title", "execution")}
    # a digest stands for a file's text, and its name does not matter; the function is for readers alone
    for name, without in (("drive", ("file", "text")), ("model", ("function",))):
        if isinstance(found.get(name), Mapping):
            found[name] = {k: v for k, v in found[name].items() if k not in without}
    if isinstance(found["model"], Mapping):
        found["model"] = _without_motion(found["model"])
    if "drift" in found:
        drift = found["drift"].items()
        found["drift"] = {name: {k: v for k, v in table.items() if k not in ("file", "text")} for name, table in drift}
    return found


def foreign_keys(identity: Mapping[str, Any], tables: Mapping[str, Any]) -> list[str]:
    """Return the keys in which an identity differs from a specification with these tables, which are plain data."""
    lines = differences(identity_tables(identity["spec"]), identity_tables(tables))
    return [line.partition(": ")[0] for line in lines]


def _without_motion(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return the text of a model without the extents of the motion: they are the measure of the analyses alone."""
    states = table.get("states")
    if not isinstance(states, Mapping):
        return dict(table)
    own = {name: _plain_entry(entry) for name, entry in states.items()}
    return {**table, "states": own}


def _plain_entry(entry: Any) -> Any:
    if not isinstance(entry, Mapping) or "motion" not in entry:
        return entry
    rest = {key: value for key, value in entry.items() if key != "motion"}
    return rest["unit"] if set(rest) == {"unit"} else rest


def _coordinates_digest(spec: Spec) -> str:
    digest = hashlib.sha256()
    for coordinate in coordinates(spec):
        values = np.asarray(coordinate.values)
        values = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
        digest.update(repr((coordinate.name, coordinate.dims, values.dtype.str, values.shape)).encode())
        digest.update(values.tobytes())
    return digest.hexdigest()[:16]


def versions_of(spec: Spec) -> dict[str, int]:
    """Return the numbers of the versions that decide the numbers of a run."""
    products = {name: CELL_PRODUCTS[name].version for name in spec.products}
    return {"engine": ENGINE, "cells": CELLS, **products}


def canonical(data: Any) -> str:
    """Return data as canonical JSON (sorted keys, shortest round-trip numbers), so that equal data give the
    same text.
    """
    return json.dumps(data, sort_keys=True, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def digest_of(identity: Mapping[str, Any]) -> str:
    """Return the digest of a run's identity, 32 hexadecimal digits."""
    return hashlib.sha256(canonical(_numbers(identity)).encode()).hexdigest()[:32]


def _numbers(data: Any) -> Any:
    """Convert whole-number floats to int, so that ``2`` and ``2.0`` give one digest; -0.0 stays a float."""
    if isinstance(data, Mapping):
        return {k: _numbers(v) for k, v in data.items()}
    if isinstance(data, (list, tuple)):
        return [_numbers(v) for v in data]
    # -0.0 has its own bits, and cells that start there may have other results
    is_minus_zero = data == 0 and isinstance(data, float) and math.copysign(1.0, data) < 0
    return int(data) if isinstance(data, float) and data.is_integer() and not is_minus_zero else data


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Return a line of text per key that differs between two identities: dotted key, old value, new value."""
    left, right = dict(_leaves(_numbers(old))), dict(_leaves(_numbers(new)))
    absent = "(absent)"
    return [
        f"{key}: {left.get(key, absent)!s} in the directory, {right.get(key, absent)!s} now"
        for key in dict.fromkeys((*left, *right))
        if left.get(key, absent) != right.get(key, absent)
    ]


def _leaves(data: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in data.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


_ENGINE = "433ffff3fca2c718"
_CELLS = {
    "compute.continuation": "3dfc5a79a3e0b7db",
    "compute.drift": "3f21b5e7040ea64d",
    "compute.integrate": "8d946736bc2d348c",
    "compute.noise": "37b17b42ecbc4112",
    "compute.recorded_drive": "85add41f2d7c465b",
    "compute.refinement": "46d684b4bb81ed6a",
    "compute.task": "e9ce1f0744f9cc3c",
    "layout.cells": "8f83262db4988cca",
    "specification.drift": "ee16a82e928425ee",
    "specification.drive_files": "e21d7c0e5ed771ef",
}
_FIT = {"identify": "00833b01be49311b", "measured_branch": "6132a38497cbd124", "recordings": "5426bd3dfd69f180"}
_PRODUCTS = {
    "compute.exponents": ("lyapunov", "3472c14d9a79a66a"),
    "compute.extremes": ("extremes", "192a69bf4adbd6b6"),
    "compute.rotation": ("rotation", "4863bbf653fd84fa"),
}


def numbered(identity: Mapping[str, Any]) -> dict[str, Any]:
    """Return an identity with numbers of versions in place of the digests of their source code; unknown ones stay."""
    if "kernel_version" not in identity:
        return dict(identity)
    code, engine = identity["code"], identity["kernel_version"]
    versions: dict[str, int | str] = {"engine": 1 if engine == _ENGINE else engine}
    for name, first in (("cells", _CELLS), ("fit", _FIT)):
        if own := {module: digest for module, digest in code.items() if module in first}:
            is_first = all(first[module] == digest for module, digest in own.items())
            versions[name] = 1 if is_first else " ".join(own.values())
    for module, (name, digest) in _PRODUCTS.items():
        if module in code:
            versions[name] = 1 if code[module] == digest else code[module]
    rest = {key: value for key, value in identity.items() if key not in ("kernel_version", "code")}
    return {**rest, "versions": versions}
