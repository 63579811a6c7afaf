"""Compile functions with numba, with an on-disk cache that never returns outdated code.

numba's own ``cache=True`` watches only the file of the cached function: after an edit of a callee in another file
the cached caller still returns the old result. Here the name of the cache folder contains a digest of all sources
of ``magpend_core`` and the versions of numba and llvmlite, so that any edit starts an empty folder. Code that calls
functions from outside the package has a subfolder, named by a digest of these functions and of all that they use
(see `digests`). numba itself separates CPU models inside a folder. The digest is one of bytes: so no rule about what
matters can let an old result through. The price is one compilation after an edit of a comment.

Reading order: `inline` compiles helpers and the functions of a system. `bound_part` and `entry` compile the templates
of the engine, with values for their free names. `keeping` says under which key the code may be cached.

Environment variables, read once at import:

``MAGPEND_CACHE``
    ``0`` compiles in every process and writes nothing.
``MAGPEND_CACHE_DIR``
    The folder of all caches; if unset or empty, ``magpend`` in the user's cache folder. Its content is executed, so
    it must belong to the user, see `code_cache`.
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

from magpend_core.engine.code_cache import PartFolder, keep
from magpend_core.engine.digests import PACKAGE, code_digest, functions_digest
from magpend_core.engine.linking import placeholder, placeholder_of_array
from magpend_core.engine.precompiled import EntryCompiler, PartDispatcher

# No fast math: `fusing` decides which products are fused, and further flags would make isnan(nan) False. The error
# model "numpy" avoids a test for 0 at every division.
F = TypeVar("F", bound=Callable[..., Any])

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "pipeline_class": EntryCompiler}

# Parts allocate nothing, so they need no reference counts (_nrt). Each count is an atomic operation: passing a tuple
# of a dozen arrays to a callee would cost a microsecond. Parts have no wrappers for Python and C, which would take
# half of the compilation time.
_OF_PARTS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "_nrt": False,
    "no_cfunc_wrapper": True,
    "no_cpython_wrapper": True,
}

# numba makes a wrapper for calls from C unless it is told not to; nothing here is called from C
WITHOUT_C: dict[str, Any] = {"no_cfunc_wrapper": True}

_SETTINGS: Any = numba.config

_PACKAGE = Path(__file__).parents[1]


def source_digest() -> str:
    """Return a digest of all source files of the numerical core, for the compile cache."""
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
    except RuntimeError:  # the user has no home folder
        return None
    folder = folder if home else folder / "magpend"
    versions = f"numba-{numba.__version__}-llvmlite-{llvmlite.__version__}"
    # absolute, since the process may change its working directory
    return folder.absolute() / f"{source_digest()}-{versions}"


CACHE_FOLDER = _cache_folder()


PARTS = PartFolder(CACHE_FOLDER) if CACHE_FOLDER is not None else None
"""Folder with the cached code of parts; None without a cache."""


def inline(function: F) -> F:
    """Compile a helper function that allocates no memory and is inlined into its compiled callers."""
    if _SETTINGS.DISABLE_JIT:
        return function

    def identity() -> str | None:
        return functions_digest(dispatcher)

    dispatcher: Any = PartDispatcher(function, {**_OF_PARTS, "forceinline": True}, {}, identity, PARTS)
    return dispatcher


class _Uncollected(event.Listener):
    """Listener that turns the garbage collector off while numba compiles, which saves time.

    The collector would take a tenth of the compilation time, to scan numba's many objects again and again.
    """

    def __init__(self) -> None:
        self._lock, self._depth, self._resumes = threading.Lock(), 0, False

    def on_start(self, event: Any) -> None:
        with self._lock:
            if self._depth == 0:
                self._resumes = gc.isenabled()
                gc.disable()
            self._depth += 1

    def on_end(self, event: Any) -> None:
        with self._lock:
            self._depth -= 1
            if self._depth == 0 and self._resumes:
                gc.enable()


event.register("numba:compiler_lock", _Uncollected())

_PARTS: dict[Any, tuple[Any, Any]] = {}
"""Compiled parts by template and values. The values are stored as well, since the keys contain their `id`."""

_SIZES = frozenset(
    (
        "N",
        "N_KNOWN",
        "N_CONTROLLED",
        "N_OWN",
        "NC",
        "NE",
        "N_WATCHED",
        "N_EVENTS",
        "N_SWITCHES",
        "N_IMPACTS",
        "N_SURFACES",
        "N_ENTRIES",
        "N_VECTORS",
        "SECTION_OF",
    )
)
"""Free names that are sizes of a system: a part is compiled once for all values above 0 (see `linking`)."""

_ARRAYS = frozenset(("IS_ANGLE", "SCALES", "SIZES", "ESCAPE", "DIRECTIONS", "STARTS", "SAME_VALUE"))
"""Free names that are arrays with an entry per state or event: a part is compiled once for all arrays."""


def bound_part(template: Callable[..., Any], bindings: Mapping[str, Any], dissolves: bool) -> Any:
    """Compile a template, with values for its free names, as a function for compiled callers. Equal values give the
    same function.

    Parameters
    ----------
    template
        A plain function that allocates nothing. Its free names get the values in `bindings`; all others keep those
        of its module.
    bindings
        Values by name; names that the template does not use are ignored.
    dissolves
        Whether the function is inlined into its callers.

    Returns
    -------
    PartDispatcher
        Function for calls from compiled code; the plain function if numba is switched off.
    """
    names = _names_in(template.__code__)
    used = {name: bindings[name] for name in sorted(names) if name in bindings}
    values = tuple((name, _identity(value, names)) for name, value in used.items())
    key = template.__code__, id(template.__globals__), dissolves, values
    if key not in _PARTS:
        _PARTS[key] = _part(template, used, dissolves, names), (template, used)
    return _PARTS[key][0]


def _part(template: Callable[..., Any], used: Mapping[str, Any], dissolves: bool, names: set[str]) -> Any:
    if _SETTINGS.DISABLE_JIT:
        return specialise(template, "part", **used)
    sizes: dict[str, Any] = {}
    # the length of the tuple that `load_rows` returns is part of its type: compile these templates for each size
    general = used if "load_rows" in names else {k: _without_size(k, v, names, sizes) for k, v in used.items()}
    digest = _template_digest(template, general, dissolves, names)
    function = specialise(template, digest[:16] if digest else "unkept", **general)
    options = {**_OF_PARTS, "forceinline": dissolves}
    return PartDispatcher(function, options, sizes, lambda: digest, PARTS)


def _without_size(name: str, value: Any, names: set[str], sizes: dict[str, Any]) -> Any:
    """Replace a system size, such as the number of states, by a placeholder and note it in `sizes`; return any other
    value unchanged.
    """
    if type(value) is int and value > 0 and name in _SIZES:
        sizes[name] = value
        return placeholder(name)
    if name in _ARRAYS and isinstance(value, np.ndarray):
        sizes[name] = value
        return placeholder_of_array(name, value)
    if name == "ROWS":
        # only the fields that the template uses: systems with other values in other fields share the part
        fields = [field for field in value._fields if field in names]
        sizes |= {f"{name}.{field}": getattr(value, field) for field in fields}
        return value._replace(**{field: placeholder(f"{name}.{field}") for field in fields})
    return value


def _template_digest(
    template: Callable[..., Any], used: Mapping[str, Any], dissolves: bool, names: set[str]
) -> str | None:
    """Return a digest of everything that determines the code of a bound template; None for a template from outside the
    package.

    A compiled function that the template calls counts by its name only, since it is linked later.
    """
    if template.__module__.partition(".")[0] != PACKAGE:
        return None
    first: dict[int, str] = {}
    rows = [template.__module__, template.__qualname__, code_digest(template.__code__), repr(dissolves)]
    for name, value in used.items():
        if hasattr(value, "py_func"):
            rows.append(f"{name} calls {first.setdefault(id(value), name)}")
        else:
            rows.append(f"{name} {_identity(value, names)!r}")
    if any(" at 0x" in row for row in rows):
        return None
    return hashlib.sha256("\n".join(rows).encode()).hexdigest()


def _names_in(code: CodeType) -> set[str]:
    within = (_names_in(c) for c in code.co_consts if isinstance(c, CodeType))
    return set(code.co_names).union(*within)


def _identity(value: Any, names: set[str]) -> Any:
    """Return a hashable key for the value of a template's free name. Values with equal keys compile to the same code.

    A named tuple counts by its fields in `names`, the only ones that the code reads.
    """
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if hasattr(value, "_fields"):
        return type(value), tuple((k, _identity(getattr(value, k), names)) for k in value._fields if k in names)
    if isinstance(value, tuple):
        return type(value), tuple(_identity(v, names) for v in value)
    if isinstance(value, bool | int | float | str):
        return type(value), repr(value)
    return id(value)


def is_covered(*functions: Callable[..., Any]) -> bool:
    """Return whether all functions are defined in ``magpend_core``, whose sources `source_digest` covers."""
    return all(f.__module__.partition(".")[0] == PACKAGE for f in functions)


def keeping(*functions: Callable[..., Any]) -> str | None:
    """Return the cache key for machine code that calls `functions`; None if the code must not be cached.

    Returns
    -------
    str or None
        Empty if `source_digest` covers the functions; else a digest of the functions and of all that they use. None
        if this cannot be found out: the code is then not cached, since a cached result could be outdated.
    """
    return "" if is_covered(*functions) else functions_digest(*functions)


def entry(
    template: Callable[..., Any], name: str, bindings: Mapping[str, Any], kept: str | None = ""
) -> Callable[..., Any]:
    """Fill in a template's free names and compile it as a function that Python can call, with its machine code cached.

    The template becomes a part. Python calls a function of one line that calls the part, because numba takes long to
    compile code that Python can call.

    Parameters
    ----------
    template
        A plain function that allocates nothing; its free names get the values in `bindings`.
    name
        Name of the system and of the computation; equal names must mean equal code.
    bindings
        Values by name; names that the template does not use are ignored.
    kept
        Cache key from `keeping`; by default the folder of `source_digest`.
    """
    code = template.__code__
    arguments = ", ".join(code.co_varnames[: code.co_argcount])
    text = f"def {template.__name__}({arguments}):\n    return _part({arguments})\n"
    scope: dict[str, Any] = {"__name__": template.__module__}
    exec(compile(text, code.co_filename, "exec"), scope)
    return kernel(specialise(scope[template.__name__], name, _part=bound_part(template, bindings, False)), kept)


def kernel(function: F, kept: str | None = "") -> F:
    """Compile a function that Python calls, and keep its machine code in the cache folder.

    If the function calls functions from outside the package, pass the result of `keeping` as `kept`.
    """
    if CACHE_FOLDER is None or kept is None:
        return njit(**OPTIONS, **WITHOUT_C)(function)
    folder = CACHE_FOLDER / kept[:32] if kept else CACHE_FOLDER
    return keep(njit(**OPTIONS, **WITHOUT_C)(function), CACHE_FOLDER.parent, folder)


def specialise(template: Callable[..., Any], name: str, **bindings: Any) -> Callable[..., Any]:
    """Return a copy of the function `template` with given values for global names; it is not compiled yet.

    numba can inline jitted functions that are globals of their caller. A closure over them would work, too, but numba
    could not find its code again in the cache. So the engine is written once as plain functions with free names; a
    copy with other globals is made here for each system.

    Parameters
    ----------
    template
        A plain Python function.
    name
        Suffix that makes the qualified name of the copy unique, and so its cache entry.
    bindings
        Values for global names used in `template`.
    """
    function = pytypes.FunctionType(
        template.__code__, {**template.__globals__, **bindings}, f"{template.__name__}_{name}", template.__defaults__
    )
    function.__qualname__ = f"{template.__qualname__}_{name}"
    function.__doc__ = template.__doc__
    function.__module__ = template.__module__
    return function
