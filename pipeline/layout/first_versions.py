"""Read the identities of runs that were begun when versions were digests of source code."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

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
