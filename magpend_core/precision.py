"""Give the integrations of a run's analyses the run's own precision.

A run chooses the unit below which states count as 0, `atol`, and how many steps a return may take. Analyses integrate
at tolerances of their own, mostly finer ones. Inside `Precision.used` they resolve the same small states as the run's
cells, and may take as many more steps as a finer tolerance needs.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, TypedDict

from magpend_core.defaults import ATOL, MOST_STEPS, RTOL


class Tolerances(TypedDict):
    """Tolerances of an integration."""

    rtol: float
    atol: float


class Limits(Tolerances):
    """Tolerances of an integration over drive periods or returns, with its limit of steps."""

    max_steps_per_period: int


@dataclass(frozen=True)
class Precision:
    """Tolerances with which the cells of a run were integrated, and their most steps per period or return."""

    rtol: float = RTOL
    atol: float = ATOL
    max_steps: int = MOST_STEPS

    @classmethod
    def of(cls, attrs: Mapping[str, Any]) -> Precision:
        """Read the precision from the attributes of a run's cube."""
        names = {"rtol": "rtol", "atol": "atol", "max_steps": "max_steps_per_period"}
        return cls(**{name: attrs[key] for name, key in names.items() if key in attrs})

    @contextlib.contextmanager
    def used(self) -> Iterator[None]:
        """Integrate with this precision inside this context."""
        token = _current.set(self)
        try:
            yield
        finally:
            _current.reset(token)

    def limits(self, rtol: float) -> Limits:
        """Return the limits of an integration at a relative tolerance.

        The absolute tolerance is as many times finer than the relative one as in the run, and at most the run's; it is
        never coarser than the relative one. The steps of a method of order 5 grow with the fifth root of the tolerance.
        """
        share = self.atol / self.rtol
        atol = rtol if share >= 1.0 else min(self.atol, rtol * share)
        more = max(1.0, self.rtol / rtol) ** 0.2
        return {"rtol": rtol, "atol": atol, "max_steps_per_period": math.ceil(max(self.max_steps, MOST_STEPS) * more)}


_PLAIN = Precision()

_current: ContextVar[Precision] = ContextVar("precision", default=_PLAIN)


def limits_at(rtol: float) -> Limits:
    """Return tolerances and limit of steps at a relative tolerance, for integrations over periods or returns."""
    return _current.get().limits(rtol)


def tolerances_at(rtol: float) -> Tolerances:
    """Return the tolerances of an integration at a relative tolerance."""
    found = limits_at(rtol)
    return {"rtol": found["rtol"], "atol": found["atol"]}
