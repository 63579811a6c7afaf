"""Tipping probabilities of runs whose basins are drawn by hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from scipy.stats import binomtest

from magpend_core.status import Status
from pipeline.analysis.tipping.declaration import OverlapOptions
from pipeline.analysis.tipping.overlaps import needs_basins, overlaps, overlaps_table
from pipeline.results.outcomes import DIVERGED
from tests.pipeline.analysis.basins.test_basins import labelled


def run_of(grids: list[np.ndarray], status: list[np.ndarray] | None = None) -> SimpleNamespace:
    """Return as much of a run as overlaps ask for; its grids of labels lie at 2.0, 2.1, ... Hz."""
    cube, ids = labelled(grids, status)
    return SimpleNamespace(cube=lambda: cube, derive=lambda name: {"attractors": ids}[name])


def grids() -> list[np.ndarray]:
    """Return two halves of 10 x 10 starts; then the left quarter is 0, and the rest 1."""
    column = np.arange(10) + np.zeros((10, 1))
    return [(column >= 5).astype(int), (column >= 3).astype(int)]


OPTIONS = {"parameter": "frequency_hz", "before": 2.0, "after": 2.1}


def test_overlaps__are_shares_of_the_first_basin() -> None:
    ds = overlaps(run_of(grids()), OverlapOptions(**OPTIONS))
    np.testing.assert_array_equal(ds["count"], [[30, 20], [0, 50]])
    np.testing.assert_allclose(ds["probability"], [[0.6, 0.4], [0.0, 1.0]])
    back = overlaps(run_of(grids()), OverlapOptions(parameter="frequency_hz", before=2.1, after=2.0))
    np.testing.assert_allclose(back["probability"], [[1.0, 0.0], [2 / 7, 5 / 7]])


def test_overlaps__intervals_hold_the_share_at_their_level() -> None:
    """Wider by Clopper and Pearson's than by Wilson's; both hold the share, and shrink with the level."""
    wide, narrow = (overlaps(run_of(grids()), OverlapOptions(**OPTIONS, confidence=c)) for c in (0.99, 0.5))
    exact = binomtest(30, 50).proportion_ci(0.99, "exact")
    assert exact.low <= wide["low"][0, 0] < narrow["low"][0, 0] < 0.6
    assert 0.6 < narrow["high"][0, 0] < wide["high"][0, 0] <= exact.high


def test_overlaps__cells_that_diverge_are_an_outcome_and_undecided_ones_none() -> None:
    first, last = grids()
    first[0] = -1
    last[9] = -1
    status = [np.where(g >= 0, Status.PERIODIC, Status.BOUNDED) for g in (first, last)]
    status[1][9] = Status.DIVERGED
    ds = overlaps(run_of([first, last], status), OverlapOptions(**OPTIONS))
    assert ds["after"].values.tolist() == [DIVERGED, 0, 1]
    np.testing.assert_array_equal(ds["count"], [[5, 24, 16], [5, 0, 40]])
    assert ds["n_unknown"] == 10
    table = overlaps_table(ds)
    assert [(row["before"], row["after"], row["count"]) for row in table.rows][:2] == [
        ("A", "diverged", 5),
        ("A", "A", 24),
    ]
    assert table.lines[-1] == "10 starts have no outcome at one of the two values and are left out"


def test_needs_basins__refuses_what_has_none() -> None:
    run = run_of(grids())
    needs_basins(run, OverlapOptions(**OPTIONS))
    with pytest.raises(ValueError, match="amplitude is not an axis of this run"):
        needs_basins(run, OverlapOptions(parameter="amplitude", before=2.0, after=2.1))
    with pytest.raises(ValueError, match=r"= 2\.05 is not on its axis; the nearest values are 2 and 2\.1"):
        needs_basins(run, OverlapOptions(parameter="frequency_hz", before=2.0, after=2.05))
    branches = SimpleNamespace(cube=lambda: xr.Dataset({"status": (("branch", "frequency"), np.zeros((2, 2)))}))
    with pytest.raises(ValueError, match="independent initial conditions"):
        needs_basins(branches, OverlapOptions(**OPTIONS))
