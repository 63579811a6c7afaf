"""Define the parameters of a model: named, bounded, validated, packed into one flat vector for the kernels.

All quantities are in the model's own units (SI for those that ship). Names are unique within a model, so
that an override or a sweep axis needs the bare name only.
"""

from __future__ import annotations

import difflib
import math
import reprlib
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from unicodedata import category

import numpy as np

if TYPE_CHECKING:
    pass

POSITIVE = "greater than 0"
NON_NEGATIVE = "0 or greater"
FRACTION = "between 0 and 1, both excluded"
FINITE = "a finite number"
LARGEST = sys.float_info.max

BOUNDS: dict[str, Callable[[float], bool]] = {
    POSITIVE: lambda x: x > 0.0,
    NON_NEGATIVE: lambda x: x >= 0.0,
    FRACTION: lambda x: 0.0 < x < 1.0,
    FINITE: lambda x: True,
}


class ParameterError(ValueError):
    """Error: one or more parameters are unknown, missing or out of bounds.

    Attributes
    ----------
    problems : list of str
        A sentence for each problem: the name, the value, the bound and what to do.
    """

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = list(problems)
        super().__init__("\n".join(self.problems))


@dataclass(frozen=True)
class Parameter:
    """Name, unit, meaning and bound of one parameter of a model.

    Attributes
    ----------
    meaning : str
        A short phrase for tables and axes.
    bound : str
        One of `BOUNDS`.
    symbol : str
        LaTeX without dollar signs; empty for the name.
    """

    name: str
    unit: str
    meaning: str
    bound: str = FINITE
    symbol: str = ""

    def problem(self, value: Any) -> str | None:
        """Return an error sentence if a value is not allowed for this parameter, else None."""
        wanted = self.bound if self.bound == FINITE else f"a number {self.bound}"
        if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
            return f"{self.name} = {reprlib.repr(value)} is not a number; give {wanted}."
        if (isinstance(value, int) and abs(value) > LARGEST) or not math.isfinite(value):
            return f"{self.name} = {reprlib.repr(value)} is not finite; give {wanted}."
        if not BOUNDS[self.bound](float(value)):
            return f"{self.name} = {reprlib.repr(value)} is out of bounds: it must be {self.bound}."
        return None


def has_controls(text: str) -> bool:
    """Return whether a text has characters that control a terminal or belong in no file; spaces and line breaks do not
    count.
    """
    return not all(c.isprintable() or c in "\n\t" or category(c) == "Zs" for c in text)


def near_names(name: str, known: Iterable[str], what: str) -> str:
    """Return a hint for an unknown name: "did you mean" with the nearest known names, or else all known names."""
    names = list(known)
    near = difflib.get_close_matches(str(name), names, n=3, cutoff=0.5)
    return f"did you mean {' or '.join(near)}?" if near else f"known {what}: {', '.join(names)}."


def unknown_name_problem(name: str, known: Iterable[str]) -> str:
    """Return an error sentence for an unknown parameter name, with the nearest known names."""
    return f"{name!r} is not a parameter; {near_names(name, known, 'names')}"
