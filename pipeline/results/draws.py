"""Summarise values over draws of the parameters: intervals, and the stretches of branches that get a band."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import xarray as xr

LEAST_SHARE = 0.5
"""Least share of the draws that have an orbit, for a band at that value of the parameter."""

LEVELS = (0.025, 0.5, 0.975)
"""Quantiles that are reported: the median and the ends of the 95 % interval."""


def stretches(places: xr.Dataset) -> Iterator[tuple[int, bool, np.ndarray]]:
    """Yield the stretches of branches over which a band is drawn: branch, stability, and the indices of the orbits by
    rising parameter.

    Parameters
    ----------
    places
        ``branch``, ``run``, ``step``, ``is_stable`` and ``share`` (of the draws that have it) over ``orbit``.

    Notes
    -----
    A stretch is cut where the branch turns back, where its stability changes, and where fewer than `LEAST_SHARE` of
    the draws have the orbit.
    """
    branch, run, step = (places[name].values for name in ("branch", "run", "step"))
    stable, there = places["is_stable"].values, places["share"].values >= LEAST_SHARE
    for key in sorted({(int(b), int(r), bool(s)) for b, r, s in zip(branch, run, stable, strict=True)}):
        chosen = np.flatnonzero((branch == key[0]) & (run == key[1]) & (stable == key[2]) & there)
        chosen = chosen[np.argsort(step[chosen], kind="stable")]
        for part in np.split(chosen, np.flatnonzero(np.diff(step[chosen]) > 1) + 1):
            if len(part) > 1:
                yield key[0], key[2], part


def interval_of(values: np.ndarray) -> tuple[float, float, float, int]:
    """Return low end, median and high end of the central 95 % of the known values, and their number."""
    known = values[np.isfinite(values)]
    low, middle, high = np.quantile(known, LEVELS) if len(known) else (np.nan, np.nan, np.nan)
    return float(low), float(middle), float(high), len(known)
