"""Compute the values of expressions that depend on parameters alone."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from magpend_core.models.text.grammar import Tree
from magpend_core.models.text.numeric import CALLS, value_of
from pipeline.importing.expressions import RefusedError, calls_in, names_in
from pipeline.importing.functions import Functions
from pipeline.importing.source import Source


def constant(source: Source, tree: Tree, extra: Mapping[str, float]) -> float:
    """Return the value of an expression of the parameters, and of names in `extra`.

    Raises
    ------
    RefusedError
        If it depends on anything else, or has no finite value.
    """
    tree = Functions(source).written_out(tree)
    known = {"pi": np.pi, **source.parameters, **extra}
    _add_parts(source, names_in(tree), known, set())
    missing = sorted(names_in(tree) - known.keys()) + sorted(calls_in(tree) - CALLS.keys())
    if missing:
        raise RefusedError(f"{source.spelled(missing[0])} has no value here; parameters have")
    value = float(value_of(tree, known))
    if not -1e300 < value < 1e300:
        raise RefusedError("the expression has no finite value")
    return value


def _add_parts(source: Source, wanted: set[str], known: dict[str, float], under_way: set[str]) -> None:
    """Add to `known` the values of the parts in `wanted` that depend on known names alone."""
    for name in sorted(wanted - known.keys() - under_way):
        if name in source.parts:
            tree = Functions(source).written_out(source.parts[name])
            _add_parts(source, names_in(tree), known, under_way | {name})
            if names_in(tree) <= known.keys() and calls_in(tree) <= CALLS.keys():
                known[name] = float(value_of(tree, known))
