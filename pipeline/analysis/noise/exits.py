"""Find the section at which noisy cells are first in another class of motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr

from magpend_core.models.model import Model
from magpend_core.models.text.scene import MIXED
from magpend_core.status import Status
from pipeline.analysis.noise.cells import PointCells
from pipeline.layout.vocabulary import FREQUENCY_DIM, parameters_of

NOT_LEFT = -1

Labels = Callable[[np.ndarray, Mapping[str, float]], np.ndarray]
"""From sections (cell, section, state) and the values of a point to codes: 0 or more in a set, below 0 undecided."""


@dataclass(frozen=True)
class Exits:
    """Exits of the cells of a parameter point, seen in intervals of time of equal length.

    Attributes
    ----------
    counted : ndarray of bool, (cell,)
        Cells that are in a set at the first counted section.
    begin : ndarray of int, (cell,)
        Code of the set in which a cell begins.
    first_out : ndarray of int, (cell,)
        Number of the first section after the exit, counted from the first counted one; `NOT_LEFT`.
    end : ndarray of int, (cell,)
        Code of the set to which a cell goes; `NOT_LEFT` where a cell did not leave, or diverged.
    place : ndarray, (cell, state)
        State after the exit; NaN if there is none.
    at_risk : ndarray of int, (cell,)
        Intervals at whose begin a cell was in its set.
    n_intervals : int
        Intervals in the record.
    interval : float
        Length of an interval [s].
    """

    counted: np.ndarray
    begin: np.ndarray
    first_out: np.ndarray
    end: np.ndarray
    place: np.ndarray
    at_risk: np.ndarray
    n_intervals: int
    interval: float


def find_exits(codes: np.ndarray, cells: PointCells, skip: int, n_transient: int, period: float) -> Exits:
    """Find the first section at which each cell is in another set than at the first.

    Parameters
    ----------
    codes
        Code of the set at each section, shape (cell, section); negative ones decide nothing.
    cells
        The cells; those that diverged leave in the period in which they did.
    skip, n_transient
        Sections that are not counted, and periods before the first section.
    period
        Time between sections [s].
    """
    seen = codes[:, skip:]
    begin = seen[:, 0]
    outside = (seen != begin[:, None]) & (seen >= 0)
    left = outside.any(axis=1)
    rows, first = np.arange(len(seen)), outside.argmax(axis=1)
    first_out = np.where(left, first, NOT_LEFT)
    end = np.where(left, seen[rows, first], NOT_LEFT)
    place = np.where(left[:, None], cells.section[rows, skip + first], np.nan)
    counted = begin >= 0
    gone = cells.status == Status.DIVERGED
    when = cells.n_periods - n_transient - 1 - skip
    # a diverged cell has no sections: it was inside as long as it was there
    first_out = np.where(gone, when, first_out)
    counted = np.where(gone, when > 0, counted & (cells.status == Status.BOUNDED))
    begin = np.where(gone, 0, begin)
    end = np.where(gone, NOT_LEFT, end)
    has_left = first_out > 0
    n = seen.shape[1] - 1
    at_risk = np.where(counted, np.where(has_left, first_out, n), 0)
    return Exits(counted, begin, np.where(has_left, first_out, NOT_LEFT), end, place, at_risk, n, period)


def labels_of(model: Model, cube: xr.Dataset) -> Labels:
    """Return the function that tells in which class of motion each section is."""
    classifier = model.classifier
    assert classifier is not None
    fixed_values = dict(parameters_of(cube))
    # one section that meets no condition of a text is between the classes, and no class of its own
    undecided = [0, *classifier.neutral, *(k for k, word in enumerate(classifier.words) if word == MIXED)]

    def by_motion(section: np.ndarray, values: Mapping[str, float]) -> np.ndarray:
        one = section.reshape(-1, 1, section.shape[-1])
        finite = np.isfinite(one).all(axis=(1, 2))
        codes = np.full(len(one), -1)
        no_turns = np.zeros((int(finite.sum()), len(model.angles)), np.int64)
        hz = np.full(int(finite.sum()), values[FREQUENCY_DIM])
        found = classifier.classify(one[finite], no_turns, hz, {**fixed_values, **values})
        decided = ~np.isin(found, undecided)
        codes[finite] = np.where(decided, found, -1)
        return codes.reshape(section.shape[:-1])

    return by_motion
