"""Write units so that UDUNITS (the CF conventions) and pint both read them; list units that neither knows."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from magpend_core.models.model import Model

GIVEN = "units_as_given"
"""Attribute of a variable with a unit that UDUNITS and pint do not both know; it then has no ``units``."""

_PREFIXES = ("", "n", "u", "m", "c", "d", "k", "M", "G")
_BASE = ("m", "g", "s", "A", "K", "mol", "cd", "rad")
_DERIVED = ("Hz", "N", "Pa", "J", "W", "C", "V", "F", "ohm", "S", "Wb", "T", "H", "bar", "L", "l", "eV")
_ALONE = ("radian", "radians", "sr", "degree", "degrees", "degC", "min", "h", "hour", "d", "day", "lm", "lx", "%")
_WORDS = ("meter", "metre", "second", "seconds", "kilogram", "newton", "hertz", "volt", "ampere", "kelvin", "percent")
_KNOWN = frozenset({*_ALONE, *_WORDS, *(prefix + unit for prefix in _PREFIXES for unit in (*_BASE, *_DERIVED))})
_SAME = {"deg": "degree", "°": "degree", "Ω": "ohm", "Ohm": "ohm", "µm": "um", "μm": "um", "sec": "s", "1": "1"}
"""Symbols that one of the two lacks or reads otherwise, and what both read."""
_COUNTS = ("", "-", "cells", "nat", "none", "dimensionless", "count", "counts")
"""Texts for numbers without a unit. pint reads `nat` as a nano-atmosphere."""

_TOKEN = re.compile(r"\s*(\*\*|[-+]?\d+|[/*.·^()]|[A-Za-zµμΩ°%]+)|\s*$")


def readable_unit(text: str) -> str | None:
    """Return a unit in a form that UDUNITS and pint read alike, such as ``m/s^2`` for ``m/s2``; None if there is none.

    Products are written with a blank or ``*``, quotients with ``/``, powers as in ``s2``, ``s^2``, ``s**2`` or
    ``s-1``. Symbols are those of the SI with the usual prefixes, and some that are used beside it (``degree``,
    ``min``, ``h``, ``%``). A text for a number without a unit becomes ``1``.
    """
    if text.strip() in _COUNTS:
        return "1"
    tokens: list[str] = []
    at = 0
    while at < len(text.rstrip()):
        match = _TOKEN.match(text, at)
        if match is None or not match[1]:
            return None
        tokens.append(match[1])
        at = match.end()
    found, left = _product(tokens)
    return found if found is not None and not left else None


def _product(tokens: list[str]) -> tuple[str | None, list[str]]:
    """Parse factors with ``/``, ``*`` or nothing between them; return their text and the tokens that are left."""
    text, left = _factor(tokens)
    while text is not None and left and left[0] != ")":
        sign = "/" if left[0] == "/" else " "
        factor, left = _factor(left[1:] if left[0] in ("/", "*", ".", "·") else left)
        text = None if factor is None else f"{text}{sign}{factor}"
    return text, left


def _factor(tokens: list[str]) -> tuple[str | None, list[str]]:
    """Parse a symbol with its power, a 1, or a product in parentheses."""
    if not tokens:
        return None, tokens
    first, left = tokens[0], tokens[1:]
    if first == "(":
        inner, left = _product(left)
        text = f"({inner})" if inner is not None and left[:1] == [")"] else None
        return text, left[1:]
    symbol = _SAME.get(first, first)
    if symbol != "1" and symbol not in _KNOWN:
        return None, left
    marked = left[:1] in (["^"], ["**"])
    power = left[int(marked) : int(marked) + 1]
    if power and re.fullmatch(r"[-+]?\d+", power[0]) and symbol != "1":
        return f"{symbol}^{int(power[0])}", left[int(marked) + 1 :]
    return (None if marked else symbol), left


def shown_unit(attrs: Mapping[Any, Any], default: str = "1") -> str:
    """Return the unit of a variable for labels and tables, as models write it: ``m/s2``."""
    return str(attrs.get(GIVEN, attrs.get("units", default))).replace("^", "")


def unit_remarks(model: Model) -> list[str]:
    """Return a line of text if a model has units that UDUNITS and pint do not both know, with their names."""
    units = [(entry.name, entry.unit) for entry in model.states]
    units += [(entry.name, entry.unit) for entry in model.parameters]
    units += [(entry.name, entry.unit) for entry in model.quantities]
    unknown: dict[str, list[str]] = {}
    for name, unit in units:
        if readable_unit(unit) is None:
            unknown.setdefault(unit, []).append(name)
    if not unknown:
        return []
    named = "; ".join(f"{unit!r} of {', '.join(names)}" for unit, names in unknown.items())
    return [
        f"units that other programs cannot read: {named}. Opened Datasets have them in the attribute {GIVEN} "
        "instead of units; write SI units such as m/s2, or 1, for results that pint-xarray converts."
    ]
