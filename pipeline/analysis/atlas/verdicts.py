"""Say of each change of the attractors what explains it: the end to which the orbit was followed, or none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from magpend_core.engine.system import System
from magpend_core.orbits import scaled_distance
from pipeline.analysis.atlas.ends import GOES_ON, SHRINKS
from pipeline.analysis.atlas.plane import Array, Change, Plane
from pipeline.analysis.branches.kinds import HOPF
from pipeline.analysis.events.kinds import LIVES_ON, UNDECIDED

SAME_AT_POINT = 1e-4
"""Scaled distance within which two stable orbits at one point are one: both are refined to far less."""


@dataclass(eq=False)
class Verdict:
    """Explanation of a change, with its place."""

    what: str
    place: Array  # values of both parameters
    error: float  # in units of the plane
    why: str = ""
    period: int = 0  # of the orbit at a bifurcation
    state: Array | None = None  # a section point of it
    curve: int = -1
    line: int = -1
    row: int = -1  # row of the orbit at the neighbour, of one that goes on

    @property
    def is_seen(self) -> bool:
        """Whether the attractors really differ: an orbit that goes on under another id is no change."""
        return self.what != GOES_ON

    @property
    def is_explained(self) -> bool:
        """Whether the change has an explanation."""
        return self.what != UNDECIDED


def verdicts(
    plane: Plane, changes: Sequence[Change], numbers: Sequence[int], ends: xr.Dataset, system: System
) -> list[Verdict]:
    """Return the verdict on each change from the ends of its orbits.

    Parameters
    ----------
    plane, changes
        The plane, and its changes.
    numbers
        Number of the end of each change; -1 of a set that is no orbit.
    ends
        Result of the analysis ``orbit_ends``.
    system
        Tells scales and angles of the states.
    """
    words = str(ends["what"].attrs["flag_meanings"]).split()
    whats = [words[code] for code in ends["what"].values.tolist()]
    places = np.stack([ends["end_first"].values, ends["end_second"].values], axis=-1)
    node_rows = rows_at(plane)
    found = []
    for change, k in zip(changes, numbers, strict=True):
        middle = plane.values[[change.here, change.there]].mean(axis=0)
        half = 0.5 * float(np.abs(np.diff(plane.scaled(plane.values[[change.here, change.there]]), axis=0)).max())
        if k < 0:
            found.append(Verdict(UNDECIDED, middle, half, "a set that is no orbit"))
            continue
        state, period = ends["end_section"].values[k], int(ends["end_period"].values[k])
        what, why = whats[k], str(ends["why"].values[k])
        if what == UNDECIDED:
            found.append(Verdict(UNDECIDED, middle, half, why))
        elif what == LIVES_ON:
            row = met_at(plane.points, node_rows[change.there], state, system)
            found.append(Verdict(LIVES_ON if row < 0 else GOES_ON, middle, half, why, period, state, row=row))
        else:
            error = float(ends["end_error"].values[k])
            found.append(Verdict(what, places[k], error, why, period, state))
    _settle_shrinking(changes, found)
    return found


def met_at(points: Sequence[Array], rows: Sequence[int], state: Array, system: System) -> int:
    """Return the row, of some at one point of the plane, of the orbit through a state; -1 if it is none of them."""
    return next(
        (row for row in rows if len(points[row]) and scaled_distance(points[row], state, system).min() < SAME_AT_POINT),
        -1,
    )


def rows_at(plane: Plane) -> list[list[int]]:
    """Return the rows of the attractors at each node."""
    rows: list[list[int]] = [[] for _ in plane.values]
    for row, node in enumerate(plane.node.tolist()):
        rows[node].append(row)
    return rows


def _settle_shrinking(changes: Sequence[Change], found: Sequence[Verdict]) -> None:
    """Give cycles that shrink to an equilibrium the Hopf point that was located between the same points."""
    hopf = {c.edge: v for c, v in zip(changes, found, strict=True) if v.what == HOPF}
    for change, one in zip(changes, found, strict=True):
        if one.what != SHRINKS:
            continue
        if (at := hopf.get(change.edge)) is not None:
            one.what, one.place, one.error, one.period, one.state = HOPF, at.place, at.error, 0, at.state
        else:
            one.what, one.why = UNDECIDED, "its cycles shrink to an equilibrium, of which no Hopf point was located"
