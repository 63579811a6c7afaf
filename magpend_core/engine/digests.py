"""Compute digests of compiled functions outside the package; a digest covers all that determines their machine code.

`jit.source_digest` does not change with such functions. So their machine code may be cached only under a digest of
everything that they use, directly or through other functions. A function that uses an object whose code is not
known has no digest, and is not cached.
"""

from __future__ import annotations

import builtins
import dis
import hashlib
import sys
from collections.abc import Callable, Iterator
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

PACKAGE = __name__.partition(".")[0]

_COMPILERS_OWN = ("math", "cmath", "numpy", "operator", "builtins")
"""Modules whose functions numba implements itself. Its version, part of the cache folder's name, covers them."""

_GLOBALS, _ATTRIBUTES = ("LOAD_GLOBAL", "LOAD_NAME"), ("LOAD_ATTR", "LOAD_METHOD")


def code_length(function: Callable[..., Any]) -> int:
    """Return the length in bytes of the bytecode of a compiled function and of the compiled functions that it calls."""
    source = getattr(function, "py_func", None)
    if source is None:
        return 0
    total = len(source.__code__.co_code)
    for path in lookups(source.__code__):
        if path[0] in source.__globals__:
            total += code_length(_found(source.__globals__[path[0]], path[1:]))
    return total


class _UnknownError(Exception):
    """Error: a function uses an object whose code is unknown, so the function has no digest."""


def functions_digest(*functions: Callable[..., Any]) -> str | None:
    """Return a digest of compiled functions and of everything they refer to.

    It covers the bytecode, its constants, the compiler options, default values, and each global or closed-over
    value that the code looks up: other compiled functions in the same way; numbers, strings, tuples and arrays by
    value; functions of this package, of numpy and of the modules of arithmetic by name.

    Parameters
    ----------
    functions
        Dispatchers of numba.

    Returns
    -------
    str or None
        64 hexadecimal digits; None if a function reaches something else, such as an object with a state.
    """
    digest = hashlib.sha256(sys.version.encode())
    seen: dict[int, int] = {}
    try:
        for function in functions:
            for part in _parts(function, seen):
                digest.update(len(part).to_bytes(8, "little"))
                digest.update(part)
    except _UnknownError:
        return None
    return digest.hexdigest()


def _parts(value: Any, seen: dict[int, int]) -> Iterator[bytes]:
    if id(value) in seen:
        yield b"again %d" % seen[id(value)]
        return
    source = getattr(value, "py_func", None)
    if isinstance(source, FunctionType):
        if source.__module__ not in sys.modules:
            # loading cached machine code imports the modules of its functions
            raise _UnknownError
        seen[id(value)] = len(seen)
        yield _options(value)
        yield from _function(source, seen)
    elif isinstance(value, tuple):
        yield f"{type(value).__name__} {getattr(value, '_fields', '')} {len(value)}".encode()
        for entry in value:
            yield from _parts(entry, seen)
    elif isinstance(value, np.ndarray) and not value.dtype.hasobject:
        yield f"array {value.dtype.str} {value.shape} {value.strides}".encode() + value.tobytes()
    else:
        yield _plain(value)


def _plain(value: Any) -> bytes:
    """Return bytes that identify a plain value by its text, or a function of numba, numpy or magpend by its name."""
    if value is None or isinstance(value, bool | int | float | complex | str | bytes | np.generic):
        return f"{type(value).__name__} {value!r}".encode()
    module = getattr(value, "__module__", None) or ""
    named = isinstance(value, FunctionType | BuiltinFunctionType | np.ufunc | type)
    known = module.partition(".")[0] in (PACKAGE, *_COMPILERS_OWN)
    if named and (known or isinstance(value, np.ufunc)):
        return f"known {module}.{getattr(value, '__qualname__', value.__name__)}".encode()
    raise _UnknownError


def _options(dispatcher: Any) -> bytes:
    options = {**dispatcher.targetoptions, "locals": dispatcher.locals}
    rows = []
    for name, option in sorted(options.items()):
        if name == "fastmath":
            flags = getattr(option, "flags", option)
            option = sorted(flags) if isinstance(flags, set | frozenset) else flags
        rows.append(f"{name}={option!r}")
    text = ";".join(rows)
    if " at 0x" in text:
        raise _UnknownError
    return text.encode()


def _function(function: FunctionType, seen: dict[int, int]) -> Iterator[bytes]:
    yield from _code(function.__code__, seen)
    yield from _parts(function.__defaults__ or (), seen)
    yield from _parts(tuple(sorted((function.__kwdefaults__ or {}).items())), seen)
    for cell in function.__closure__ or ():
        yield from _parts(cell.cell_contents, seen)
    for path in lookups(function.__code__):
        yield ".".join(path).encode()
        if path[0] in function.__globals__:
            yield from _parts(_found(function.__globals__[path[0]], path[1:]), seen)
        elif not hasattr(builtins, path[0]):
            raise _UnknownError


def reached(function: Any, path: tuple[str, ...]) -> Any:
    """Return the global object that a function finds at a dotted path (see `lookups`); None if there is none."""
    return _found(function.__globals__.get(path[0]), path[1:])


def _found(value: Any, attributes: tuple[str, ...]) -> Any:
    """Follow a dotted path such as ``module.submodule.NAME`` from module to module, up to the first object that is no
    module.
    """
    for name in attributes:
        if not isinstance(value, ModuleType):
            break
        value = getattr(value, name, None)
    return value


def code_digest(code: CodeType) -> str:
    """Return a digest of a function's bytecode and constants, without the globals that it looks up."""
    digest = hashlib.sha256(sys.version.encode())
    for part in _code(code, {}):
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    return digest.hexdigest()


def _code(code: CodeType, seen: dict[int, int]) -> Iterator[bytes]:
    yield code.co_code
    yield repr((code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)).encode()
    yield repr((code.co_argcount, code.co_kwonlyargcount, code.co_flags)).encode()
    yield code.co_exceptiontable
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _code(constant, seen)
        elif isinstance(constant, frozenset):
            yield repr(sorted(constant, key=repr)).encode()
        else:
            yield from _parts(constant, seen)


def lookups(code: CodeType) -> list[tuple[str, ...]]:
    """Return the global names that a function and its inner functions look up, each with the attributes
    read from it.
    """
    found: set[tuple[str, ...]] = set()
    path: tuple[str, ...] = ()
    for instruction in dis.get_instructions(code):
        if instruction.opname in _ATTRIBUTES and path:
            path = (*path, instruction.argval)
            continue
        found.add(path)
        path = (instruction.argval,) if instruction.opname in _GLOBALS else ()
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            found.update(lookups(constant))
    return sorted(found - {()})
