"""Compile functions with numba, with an on-disk cache that never returns outdated code.

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
    executed: it must be the user's own, see `code_cache`.
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

# No fast math: which products are fused is said by `fusing`, and wider flags would turn isnan(nan) into
# False. The default error model would add a branch to every division.
F = TypeVar("F", bound=Callable[..., Any])

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "pipeline_class": EntryCompiler}

# A function that allocates nothing needs no reference counts, and each is an atomic operation: passing
# a tuple of a dozen arrays to a callee costs a microsecond. Parts have no wrappers for Python and C: those
# take half of the time to compile.
_OF_PARTS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "_nrt": False,
    "no_cfunc_wrapper": True,
    "no_cpython_wrapper": True,
}

# numba makes a wrapper for C of every function that has none forbidden, though nothing here is called from C.
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
    except RuntimeError:  # nobody's home
        return None
    folder = folder if home else folder / "magpend"
    versions = f"numba-{numba.__version__}-llvmlite-{llvmlite.__version__}"
    # absolute, so that it stays where it is when the process goes elsewhere
    return folder.absolute() / f"{source_digest()}-{versions}"


CACHE_FOLDER = _cache_folder()


PARTS = PartFolder(CACHE_FOLDER) if CACHE_FOLDER is not None else None
"""Where the code of parts is kept."""


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

    A tenth of the time went into looking at them again and again.
    """

    def __init__(self) -> None:
        self._lock, self._depth, self._resumes = threading.Lock(), 0, False

    def on_start(self, event: Any) -> None:
        """Turn the garbage collector off when the compilation of a function begins."""
        with self._lock:
            if self._depth == 0:
                self._resumes = gc.isenabled()
                gc.disable()
            self._depth += 1

    def on_end(self, event: Any) -> None:
        """Turn the garbage collector on again when the outermost compilation has ended."""
        with self._lock:
            self._depth -= 1
            if self._depth == 0 and self._resumes:
                gc.enable()


event.register("numba:compiler_lock", _Uncollected())

_PARTS: dict[Any, tuple[Any, Any]] = {}
"""Parts by what they are made of, each with what must live as long: identities are in its key."""

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
        "N_ENTRIES",
        "N_VECTORS",
        "SECTION_OF",
    )
)
"""Free names that stand for sizes of a system: a part is compiled once for all values above 0."""

_ARRAYS = frozenset(("IS_ANGLE", "SCALES", "ESCAPE", "DIRECTIONS", "STARTS", "SAME_VALUE"))
"""Free names that stand for arrays with an entry for each state or event: likewise."""


def bound_part(template: Callable[..., Any], bindings: Mapping[str, Any], dissolves: bool) -> Any:
    """Fill in a template's free names and compile it, for calls from compiled code only. Equal names and values give
    one function.

    Parameters
    ----------
    template
        A plain function; its free names in `bindings` are bound, the others are its module's. It allocates
        nothing.
    bindings
        More than it uses may be in there.
    dissolves
        Whether it becomes a part of its callers.

    Returns
    -------
    PartDispatcher
        What only compiled functions may call; the plain function where numba is switched off.
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
    # how many rows are loaded at once is a type, so that these templates are compiled for each size
    general = used if "load_rows" in names else {k: _without_size(k, v, names, sizes) for k, v in used.items()}
    digest = _template_digest(template, general, dissolves, names)
    function = specialise(template, digest[:16] if digest else "unkept", **general)
    options = {**_OF_PARTS, "forceinline": dissolves}
    return PartDispatcher(function, options, sizes, lambda: digest, PARTS)


def _without_size(name: str, value: Any, names: set[str], sizes: dict[str, Any]) -> Any:
    """Return a placeholder for a system size (such as the number of states) and note the size in `sizes`; else return
    `value`.
    """
    if type(value) is int and value > 0 and name in _SIZES:
        sizes[name] = value
        return placeholder(name)
    if name in _ARRAYS and isinstance(value, np.ndarray):
        sizes[name] = value
        return placeholder_of_array(name, value)
    if name == "ROWS":
        # of the fields only those that are used: systems that agree in them share the part
        fields = [field for field in value._fields if field in names]
        sizes |= {f"{name}.{field}": getattr(value, field) for field in fields}
        return value._replace(**{field: placeholder(f"{name}.{field}") for field in fields})
    return value


def _template_digest(
    template: Callable[..., Any], used: Mapping[str, Any], dissolves: bool, names: set[str]
) -> str | None:
    """Return a digest of everything that determines the code of a bound template; None for a template from outside the
    package.

    Compiled functions count as where they are found: they are linked, whatever they are.
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
    """Return the global names that a function and its inner functions use."""
    within = (_names_in(c) for c in code.co_consts if isinstance(c, CodeType))
    return set(code.co_names).union(*within)


def _identity(value: Any, names: set[str]) -> Any:
    """Return a hashable key of a value for a template's free name; values with equal keys compile to the same code.

    Of a tuple with named fields it is the fields that are in `names`: they are looked up by name alone.
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
        Empty if `source_digest` covers them; else a digest of the functions and of all that they reach; None
        if that cannot be found out: then the code is not kept, since a kept answer could be an old one.
    """
    return "" if is_covered(*functions) else functions_digest(*functions)


def entry(
    template: Callable[..., Any], name: str, bindings: Mapping[str, Any], kept: str | None = ""
) -> Callable[..., Any]:
    """Fill in a template's free names and compile it as a function that Python can call, with its machine code cached.

    The template becomes a part. What Python calls is one line around it, since numba takes long over code
    that is reached from Python.

    Parameters
    ----------
    template
        A plain function that allocates nothing; its free names in `bindings` are bound.
    name
        Of the system and what is done with it: one name, one content.
    bindings
        More than the template uses may be in there.
    kept
        See `keeping`; by default the folder that `source_digest` names.
    """
    code = template.__code__
    arguments = ", ".join(code.co_varnames[: code.co_argcount])
    text = f"def {template.__name__}({arguments}):\n    return _part({arguments})\n"
    scope: dict[str, Any] = {"__name__": template.__module__}
    exec(compile(text, code.co_filename, "exec"), scope)
    return kernel(specialise(scope[template.__name__], name, _part=bound_part(template, bindings, False)), kept)


def kernel(function: F, kept: str | None = "") -> F:
    """Compile a function that Python calls, and keep its machine code in the cache folder.

    Pass what `keeping` says of the functions that it calls if some may be from outside the package.
    """
    if CACHE_FOLDER is None or kept is None:
        return njit(**OPTIONS, **WITHOUT_C)(function)
    folder = CACHE_FOLDER / kept[:32] if kept else CACHE_FOLDER
    return keep(njit(**OPTIONS, **WITHOUT_C)(function), CACHE_FOLDER.parent, folder)


def specialise(template: Callable[..., Any], name: str, **bindings: Any) -> Callable[..., Any]:
    """Return a copy of the function `template` with given values for global names; it is not compiled yet.

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
        template.__code__, {**template.__globals__, **bindings}, f"{template.__name__}_{name}", template.__defaults__
    )
    function.__qualname__ = f"{template.__qualname__}_{name}"
    function.__doc__ = template.__doc__
    function.__module__ = template.__module__
    return function
