"""Turn a compiled function, and all functions that it calls, back into the plain Python they were compiled from.

The attribute ``py_func`` of a compiled function is plain Python, but still calls compiled functions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from types import CellType, CodeType, FunctionType, ModuleType
from typing import Any

from numba import config


class _PlainModule:
    """Proxy of a module that gives the plain Python versions of its compiled functions."""

    def __init__(self, module: ModuleType, known: dict[int, Any]) -> None:
        self._module, self._known = module, known

    def __getattr__(self, name: str) -> Any:
        return _replaced(getattr(self._module, name), self._known)


def plain(
    function: Callable[..., Any], substitutes: Mapping[Callable[..., Any], Callable[..., Any]] | None = None
) -> Callable[..., Any]:
    """Return the plain Python version of a compiled function, calling plain Python versions of its callees.

    Parameters
    ----------
    function
        Dispatcher of numba, recognised by its attribute ``py_func``; any other object is returned unchanged.
    substitutes
        Functions to call in place of some callees.
    """
    known = {id(own): other for own, other in (substitutes or {}).items()}
    found: Callable[..., Any] = _replaced(function, known)
    return found


def _replaced(value: Any, known: dict[int, Any]) -> Any:
    if id(value) in known:
        return known[id(value)]
    source = getattr(value, "py_func", value if _is_left_plain(value) else None)
    if isinstance(source, FunctionType):
        return _rebuilt(value, source, known)
    if isinstance(value, ModuleType):
        return _PlainModule(value, known)
    return value


def _is_left_plain(value: Any) -> bool:
    """Return whether a function of the engine or of a model was not compiled, as with ``NUMBA_DISABLE_JIT``."""
    return bool(config.DISABLE_JIT) and str(getattr(value, "__module__", "")).startswith("magpend_core.")


def _rebuilt(dispatcher: Any, source: FunctionType, known: dict[int, Any]) -> FunctionType:
    cells = tuple(CellType() for _ in source.__closure__ or ())
    scope = dict(source.__globals__)
    function = FunctionType(source.__code__, scope, source.__name__, source.__defaults__, cells)
    function.__kwdefaults__ = source.__kwdefaults__
    known[id(dispatcher)] = function  # before its callees are replaced, since it may call itself
    for name in set(_names(source.__code__)):
        if name in scope:
            scope[name] = _replaced(scope[name], known)
    for own, cell in zip(cells, source.__closure__ or (), strict=True):
        own.cell_contents = _replaced(cell.cell_contents, known)
    return function


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)
