"""Name the ends of attractors in a window of neighbouring values of a parameter, with branches in and near it alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import xarray as xr

from magpend_core.models.model import Parameters
from pipeline.analysis.branches.dataset import dataset_of
from pipeline.analysis.branches.exploring import Scope, explore
from pipeline.analysis.branches.starting_orbits import attracting
from pipeline.analysis.events.analysis import ends_of
from pipeline.layout.own_words import rate_of
from pipeline.layout.vocabulary import axis_name
from pipeline.products.reporting import silent


def events_within(
    part: xr.Dataset,
    parameter: str,
    base: Parameters,
    interval: tuple[float, float],
    max_period: int = 0,
    between: tuple[float, float] | None = None,
    echo: Callable[[str], None] = silent,
) -> xr.Dataset:
    """Name the events of attractors at a few neighbouring values of a parameter.

    Parameters
    ----------
    part
        Attractors with plain names at neighbouring values on the parameter's axis, and at one value of each other one
        (`pipeline.results.ragged.isel`).
    parameter
        Name of the parameter.
    base
        Parameters of the run, apart from those on its axes.
    interval
        First and last value of the whole axis. Its length counts as 1: steps along branches, and least errors, are
        shares of it. Branches are followed beyond the window, but not beyond this interval.
    max_period
        Longest period of branches; 0: that with three doublings of the longest orbit in the window.
    between
        Two neighbouring values in the window: only ends of chaotic sets and tori between them are decided. None: all.
    echo
        Function that prints a line.

    Returns
    -------
    Dataset
        As of the analysis ``events``. Ends at the first and the last value of the window are ends of the range.
    """
    doubled = 4  # branches on which a cascade needs doublings have up to so many times the period of the first one
    # distance beyond the window up to which branches are followed, in mean distances of its values: from so far the
    # doublings tell that the set belongs to the cascade, see `cascades.cascade_of`
    beside = 10.0
    axis = axis_name(parameter)
    values, scale = part[axis].values, interval[1] - interval[0]
    reach = beside * float(np.ptp(values)) / (len(values) - 1)
    low, high = max(float(values.min()) - reach, interval[0]), min(float(values.max()) + reach, interval[1])
    starts, left_out = attracting(part, base, axis, (low, high), max_period, scale)
    longest = max_period or doubled * max([1, *(start.family.period for start in starts)])
    located = dataset_of(explore(starts, Scope(low, high, longest)), axis, base, left_out, rate_of(part))
    return ends_of(part, located, axis, base, scale, between=between, echo=echo)
