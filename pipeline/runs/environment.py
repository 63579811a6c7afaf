"""Describe where magpend runs, for reports of errors: Python, system, CPU, packages, folder of compiled code."""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Iterator
from importlib import metadata

from pipeline.products.product import padded

_FEATURES = ("avx", "avx2", "avx512f", "fma", "neon", "sve")
"""Vector instructions, and the product with a sum in one instruction, which kernels use where the CPU has them."""


def show_versions() -> None:
    """Print what a report of an error needs: versions, system, CPU, packages and the folder of compiled kernels."""
    print("\n".join(versions_in_words()))


def versions_in_words() -> list[str]:
    """Return the lines that `show_versions` prints."""
    from magpend_core.engine.jit import CACHE_FOLDER
    from pipeline.store.provenance import git_commit

    head = {
        "magpend": " ".join([metadata.version("magpend"), git_commit()]).strip(),
        "python": f"{platform.python_version()} ({platform.python_implementation()})",
        "system": platform.platform(),
        "cpu": f"{_cpu()}; {os.cpu_count()} cores",
        "compiled code": str(CACHE_FOLDER or "not kept (MAGPEND_CACHE=0, or no home folder)"),
    }
    head |= {name: value for name, value in os.environ.items() if name.startswith(("MAGPEND_", "NUMBA_"))}
    packages = {kind: [(name, _installed(name)) for name in names] for kind, names in _packages().items()}
    lines = padded([*head.items()], "")
    for kind, found in packages.items():
        lines += ["", kind, *padded(found)]
    return lines


def _cpu() -> str:
    """Return the model of the CPU as LLVM names it, and which of the features that kernels use it has."""
    from llvmlite.binding import get_host_cpu_name
    from numba.core import config
    from numba.core.codegen import get_host_cpu_features

    name = config.CPU_NAME or get_host_cpu_name()  # type: ignore[attr-defined]
    features = config.CPU_FEATURES  # type: ignore[attr-defined]
    text = get_host_cpu_features() if features is None else features  # type: ignore[no-untyped-call]
    return f"{name} with {', '.join(one for one in _FEATURES if f'+{one}' in text.split(',')) or 'none'}"


def _packages() -> dict[str, list[str]]:
    """Return the packages that magpend requires, and those that an extra names, by kind."""
    found: dict[str, list[str]] = {"required packages": [], "optional packages": []}
    for name, extra in _requirements():
        found["optional packages" if extra else "required packages"].append(f"{name} ({extra})" if extra else name)
    return found


def _requirements() -> Iterator[tuple[str, str]]:
    for line in metadata.requires("magpend") or ():
        name, extra = re.match(r"([\w.-]+)", line), re.search(r"extra == ['\"](\w+)", line)
        assert name is not None
        yield name[1], extra[1] if extra else ""


def _installed(name: str) -> str:
    try:
        return metadata.version(name.partition(" ")[0])
    except metadata.PackageNotFoundError:
        return "not installed"
