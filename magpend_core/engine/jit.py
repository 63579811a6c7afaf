"""How magpend compiles: the decorators, and a compile cache that cannot return an old answer.

numba's own ``cache=True`` watches the file of the cached function alone: after an edit of a callee
in another file the cached caller goes on returning the old result. Here the cache folder is named
by a digest of all sources of ``magpend_core`` with the versions of numba and llvmlite, so that any
edit starts an empty folder. numba itself separates CPU models inside it. The digest is of bytes, not of
meaning like `kernel_version`: no rule about what matters can then let an old answer through, and one
compilation is all that a needless change costs.

Environment variables, read once at import:

``MAGPEND_CACHE``
    ``0`` compiles in every process and writes nothing.
``MAGPEND_CACHE_DIR``
    The folder that holds the caches; by default ``magpend`` in the user's cache folder.
"""

from __future__ import annotations

import hashlib
import os
import types as pytypes
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import llvmlite
import numba
from numba import njit

# `contract` lets a product and a sum become one fused operation and nothing else: wider flags would
# turn isnan(nan) into False. The default error model would add a branch to every division.
F = TypeVar("F", bound=Callable[..., Any])

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}

# A function that allocates nothing needs no reference counts, and each is an atomic operation: passing
# a tuple of a dozen arrays to a callee costs a microsecond.
UNCOUNTED: dict[str, Any] = {**OPTIONS, "_nrt": False}

_PACKAGE = Path(__file__).parents[1]


def source_digest() -> str:
    """Digest of the numerical core for the compile cache: the bytes of every source, in name order."""
    digest = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        digest.update(path.relative_to(_PACKAGE).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder() -> Path | None:
    if os.environ.get("MAGPEND_CACHE", "1") == "0":
        return None
    home = os.environ.get("MAGPEND_CACHE_DIR")
    if home is None:
        base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
        home = str(Path(base) / "magpend")
    versions = f"numba-{numba.__version__}-llvmlite-{llvmlite.__version__}"
    return Path(home) / f"{source_digest()}-{versions}"


CACHE_FOLDER = _cache_folder()


def inline(function: F) -> F:
    """Compile a helper of the hot path, which allocates nothing; it dissolves into its caller."""
    return njit(forceinline=True, **UNCOUNTED)(function)


def is_covered(*functions: Callable[..., Any]) -> bool:
    """Whether `source_digest` covers the functions: whether all are defined in ``magpend_core``."""
    return all(f.__module__.partition(".")[0] == "magpend_core" for f in functions)


def kernel(function: F, cached: bool = True) -> F:
    """Compile an entry point and keep its machine code in the digest-named cache folder.

    Pass ``cached=False`` for one that calls functions from outside the package (see `is_covered`):
    the digest does not change with them, so a kept answer could be an old one.
    """
    if CACHE_FOLDER is None or not cached:
        return njit(**OPTIONS)(function)
    # numba picks the folder while it decorates; the setting is put back so that other users of
    # numba in the same process keep theirs.
    settings: Any = numba.config
    before, settings.CACHE_DIR = settings.CACHE_DIR, str(CACHE_FOLDER)
    try:
        return njit(cache=True, **OPTIONS)(function)
    finally:
        settings.CACHE_DIR = before


def specialise(template: Callable[..., Any], name: str, **bindings: Any) -> Callable[..., Any]:
    """Return `template` as a new plain function in which the given global names are bound.

    numba inlines jitted functions that it finds as globals, but a function that closes over them
    can never be found again in the compile cache. So the engine is written once as plain
    functions with free names, and bound to a system here.

    Parameters
    ----------
    template
        A plain Python function.
    name
        Suffix that makes the result's qualified name, hence its cache entry, its own.
    bindings
        Values for global names used in `template`.
    """
    function = pytypes.FunctionType(
        template.__code__,
        {**template.__globals__, **bindings},
        f"{template.__name__}_{name}",
        template.__defaults__,
    )
    function.__qualname__ = f"{template.__qualname__}_{name}"
    function.__doc__ = template.__doc__
    function.__module__ = template.__module__
    return function
