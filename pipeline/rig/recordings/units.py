"""Convert the units of recordings to SI units."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

_WITH_UNIT = re.compile(r"\s*(.*?)\s*[\[(]([^\[\]()]+)[\])]\s*")
"""A column's name, and its unit in brackets."""

_DEGREE, _TURN = math.pi / 180.0, 2.0 * math.pi

UNITS: dict[str, dict[str, float]] = {
    "rad": {
        "rad": 1.0,
        "mrad": 1e-3,
        "deg": _DEGREE,
        "degree": _DEGREE,
        "degrees": _DEGREE,
        "°": _DEGREE,
        "turn": _TURN,
        "turns": _TURN,
        "rev": _TURN,
    },
    "rad/s": {
        "rad/s": 1.0,
        "mrad/s": 1e-3,
        "deg/s": _DEGREE,
        "°/s": _DEGREE,
        "turns/s": _TURN,
        "rev/s": _TURN,
        "rpm": _TURN / 60.0,
    },
    "N m": {"N m": 1.0, "Nm": 1.0, "N*m": 1.0, "mN m": 1e-3, "mNm": 1e-3, "N cm": 1e-2, "Ncm": 1e-2},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
}
"""Factors to an SI unit, by that unit and by the unit in a file."""

_SPELLINGS = {
    "volt": "V",
    "volts": "V",
    "ampere": "A",
    "amperes": "A",
    "radian": "rad",
    "radians": "rad",
    "second": "s",
    "seconds": "s",
    "newtons": "N",
    "newton": "N",
}


def spelled(unit: str) -> str:
    """Return the symbol of a unit that is spelled out, such as V for ``Volts``."""
    return _SPELLINGS.get(unit.strip().lower(), unit.strip())


def factor(unit: str, wanted: str) -> float | None:
    """Return the factor from a unit to an SI unit; None if the two measure different quantities or the unit is unknown.

    An empty unit is the wanted one.
    """
    return 1.0 if unit in ("", wanted) else UNITS.get(wanted, {}).get(unit)


def kind_of(unit: str) -> str | None:
    """Return the SI unit that a unit can be converted to. Return None if the unit is unknown."""
    return next((si for si, known in UNITS.items() if unit in known), None)


def same(one: str, other: str) -> bool:
    """Return whether two spellings mean the same unit."""
    one, other = spelled(one), spelled(other)
    kind = kind_of(one)
    alike = kind is not None and kind == kind_of(other) and factor(one, kind) == factor(other, kind)
    return one == other or alike


def names_with_unit(wanted: str, names: Sequence[str]) -> list[tuple[str, str]]:
    """Return the names, such as ``Winkel oben [deg]``, that are `wanted` and a unit in brackets, with the unit."""
    parts = [(name, match) for name in names if (match := _WITH_UNIT.fullmatch(name))]
    return [(name, match[2]) for name, match in parts if match[1] == wanted.strip()]
