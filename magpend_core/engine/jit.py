"""How magpend compiles: the decorators, and a compile cache that cannot return an old answer.

numba's own ``cache=True`` watches the file of the cached function alone: after an edit of a callee
in another file the cached caller goes on returning the old result. Here the cache folder is named
by a digest of all sources of ``magpend_core`` with the versions of numba and llvmlite, so that any
edit starts an empty folder. What calls functions from outside the package has a folder of its own in
there, named by a digest of those functions and of all that they reach (see `digests`). numba itself
separates CPU models inside it. The digest is of bytes, not of meaning like `kernel_version`: no rule about
what matters can then let an old answer through, and one compilation is all that a needless change costs.

Environment variables, read once at import:

``MAGPEND_CACHE``
    ``0`` compiles in every process and writes nothing.
``MAGPEND_CACHE_DIR``
    The folder that holds the caches; unset or empty, ``magpend`` in the user's cache folder. What is in it is
    executed: it must be the user's own, see `kept`.
"""

from __future__ import annotations

import gc
import hashlib
import os
import threading
import types as pytypes
from collections.abc import Callable, Mapping
from pathlib import Path
from types import CodeType
from typing import Any, TypeVar

import llvmlite
import numba
import numpy as np
from numba import njit
from numba.core import event

from magpend_core.engine.digests import PACKAGE, functions_digest
from magpend_core.engine.kept import keep
from magpend_core.engine.parts import FusingCompiler, PartCompiler, RawCompiler

# No fast math: which products are fused is said by `fused`, and wider flags would turn isnan(nan) into
# False. The default error model would add a branch to every division.
F = TypeVar("F", bound=Callable[..., Any])

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "pipeline_class": FusingCompiler}

# A function that allocates nothing needs no reference counts, and each is an atomic operation: passing
# a tuple of a dozen arrays to a callee costs a microsecond.
UNCOUNTED: dict[str, Any] = {**OPTIONS, "_nrt": False}

# A door for C is made for every function that has none forbidden, though nothing here is called through one.
WITHOUT_C: dict[str, Any] = {"no_cfunc_wrapper": True}

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
    try:
        folder = Path(home or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:  # nobody's home
        return None
    folder = folder if home else folder / "magpend"
    versions = f"numba-{numba.__version__}-llvmlite-{llvmlite.__version__}"
    # absolute, so that it stays where it is when the process goes elsewhere
    return folder.absolute() / f"{source_digest()}-{versions}"


CACHE_FOLDER = _cache_folder()


def inline(function: F) -> F:
    """Compile a helper of the hot path, which allocates nothing; it dissolves into its caller."""
    return njit(forceinline=True, **UNCOUNTED, **WITHOUT_C)(function)


def part(function: F, dissolves: bool, short: bool = False) -> F:
    """Compile a part of an engine, which only compiled functions may call.

    It has neither a door for Python nor machine code of its own, which take half of the time to compile: a
    call from Python would end the process.

    Parameters
    ----------
    function
        It allocates nothing.
    dissolves
        Whether it becomes a part of its callers.
    short
        Whether the engine is small enough to be optimised as a whole.
    """
    compiler = RawCompiler if short else PartCompiler
    options = {**UNCOUNTED, **WITHOUT_C, "no_cpython_wrapper": True, "pipeline_class": compiler}
    return njit(forceinline=dissolves, **options)(function)


class _Uncollected(event.Listener):
    """Lets the garbage collector rest while numba compiles: its trees live until the end, and are many.

    A tenth of the time went into looking at them again and again.
    """

    def __init__(self) -> None:
        self._lock, self._depth, self._resumes = threading.Lock(), 0, False

    def on_start(self, event: Any) -> None:
        """Compilation begins, of a function or of one that it calls."""
        with self._lock:
            if self._depth == 0:
                self._resumes = gc.isenabled()
                gc.disable()
            self._depth += 1

    def on_end(self, event: Any) -> None:
        """It has ended."""
        with self._lock:
            self._depth -= 1
            if self._depth == 0 and self._resumes:
                gc.enable()


event.register("numba:compiler_lock", _Uncollected())

_PARTS: dict[Any, tuple[Any, Any]] = {}
"""Parts by what they are made of, each with what must live as long: identities are in its key."""


def bound_part(
    template: Callable[..., Any], name: str, bindings: Mapping[str, Any], dissolves: bool,
    short: bool = False,
) -> Any:  # fmt: skip
    """Bind a template and compile it as a part; a part of the same template and values is the same one.

    Half of what an engine is made of knows no equations: where two engines agree in what a part uses, it is
    compiled once for both.

    Parameters
    ----------
    template
        A plain function; its free names in `bindings` are bound, the others are its module's.
    name
        Of the engine: one name, one content, also of what other processes have kept. Their machine code and
        that of this process are linked by names, so that two parts of one name would be taken for each other.
    bindings
        More than it uses may be in there.
    dissolves, short
        See `part`.
    """
    names = _names_in(template.__code__)
    used = {name: bindings[name] for name in sorted(names) if name in bindings}
    values = tuple((name, _identity(value, names)) for name, value in used.items())
    key = template.__code__, id(template.__globals__), dissolves, short, values
    if key not in _PARTS:
        function = specialise(template, name, **used)
        _PARTS[key] = part(function, dissolves, short), (template, used)
    return _PARTS[key][0]


def _names_in(code: CodeType) -> set[str]:
    """Names that a function looks up, and those that functions within it do."""
    within = (_names_in(c) for c in code.co_consts if isinstance(c, CodeType))
    return set(code.co_names).union(*within)


def _identity(value: Any, names: set[str]) -> Any:
    """What decides how a value is compiled: equal numbers of two types are two things.

    Of a tuple with named fields it is the fields that are in `names`: they are looked up by name alone.
    """
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if hasattr(value, "_fields"):
        return type(value), tuple(
            (k, _identity(getattr(value, k), names)) for k in value._fields if k in names
        )
    if isinstance(value, tuple):
        return type(value), tuple(_identity(v, names) for v in value)
    if isinstance(value, bool | int | float | str):
        return type(value), repr(value)
    return id(value)


def is_covered(*functions: Callable[..., Any]) -> bool:
    """Whether `source_digest` covers the functions: whether all are defined in ``magpend_core``."""
    return all(f.__module__.partition(".")[0] == PACKAGE for f in functions)


def keeping(*functions: Callable[..., Any]) -> str | None:
    """Return under what the machine code of an entry point that calls `functions` is kept.

    Returns
    -------
    str or None
        Empty if `source_digest` covers them; else a digest of the functions and of all that they reach; None
        if that cannot be found out: then the code is not kept, since a kept answer could be an old one.
    """
    return "" if is_covered(*functions) else functions_digest(*functions)


def kernel(function: F, kept: str | None = "") -> F:
    """Compile an entry point and keep its machine code in the digest-named cache folder.

    Pass what `keeping` says of the functions that it calls if some may be from outside the package.
    """
    if CACHE_FOLDER is None or kept is None:
        return njit(**OPTIONS, **WITHOUT_C)(function)
    folder = CACHE_FOLDER / kept[:32] if kept else CACHE_FOLDER
    return keep(njit(**OPTIONS, **WITHOUT_C)(function), CACHE_FOLDER.parent, folder)


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
