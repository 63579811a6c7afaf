"""Refine the intervals of events: run further values of the parameter until they are as short as asked for."""

from __future__ import annotations

from pathlib import PurePath

import numpy as np
import xarray as xr

from pipeline.analysis.events.declaration import EventOptions
from pipeline.analysis.events.kinds import LIVES_ON, RANGE_END, UNDECIDED
from pipeline.layout.vocabulary import FREQUENCY_DIM, axis_name
from pipeline.results.run import OpenRun
from pipeline.results.tabular import counted, words_of
from pipeline.specification.tables import RATES


def refined(run: OpenRun, options: EventOptions) -> xr.Dataset:
    """Name the events of the run beside this one, which has further values in the intervals of open events.

    An interval is divided until it is at most `options.refine` long, or its event is decided with an error that is not
    larger. In a continuation each further value begins where the one before it ends, so that the values after it have
    other cells than the run.

    Returns
    -------
    Dataset
        As of the analysis ``events`` of the run beside, whose letters it has. Its attribute ``refined`` names that run,
        and ``n_further`` is the number of further values.
    """
    given = {**options.part(EventOptions), "refine": 0.0}
    beside = run.with_values([])
    while True:
        found = beside.derive("events", **given)
        values = further_values(found, options.refine, _unit_of(run, options))
        if not values:
            break
        run.echo(f"events: {counted(len(values), 'further value')} of {options.parameter}")
        finer = run.with_values(values)
        if finer.digest == beside.digest:  # there is no further number between two values
            break
        beside = finer
    axis = axis_name(options.parameter)
    n_more = beside.cube().sizes[axis] - run.cube().sizes[axis]
    return found.assign_attrs(refined=PurePath(beside.info.name).name if n_more else "", n_further=n_more)


def _unit_of(run: OpenRun, options: EventOptions) -> str:
    """Return the word in which the width of an interval is given."""
    return run.spec.rate if axis_name(options.parameter) == FREQUENCY_DIM else ""


def further_values(ds: xr.Dataset, width: float, word: str = "") -> list[float]:
    """Return the values that divide the intervals of open events which are longer than a width.

    Parameters
    ----------
    ds
        From the analysis ``events``.
    width
        Longest interval that is left as it is, in the unit of the parameter or of `word`.
    word
        Word for the drive's rate in which the width is given, if the parameter is the frequency.
    """
    # parts into which a round divides an interval. Bisection needs a third fewer cells and twice as many rounds, each
    # of which follows the branches again.
    parts = 4
    what = np.array(words_of(ds["what"]))[ds["what"].values]
    seen, beyond = ds["seen"].values, ds["beyond"].values
    ends = np.sort(np.stack([seen, beyond]), axis=0)
    shown = RATES[word].given(ends) if word else ends
    # comparisons with NaN, of the ends of the range, are false
    long = np.abs(shown[1] - shown[0]) > width * (1.0 + 1e-9)
    is_open = (what == UNDECIDED) | (ds["value_error"].values > width)
    chosen = np.flatnonzero(long & is_open & ~np.isin(what, [RANGE_END, LIVES_ON]))
    shares = np.arange(1, parts) / parts
    values = {float(a + share * (b - a)) for a, b in ends.T[chosen].tolist() for share in shares}
    return sorted(values - {x for pair in ends.T[chosen].tolist() for x in pair})
