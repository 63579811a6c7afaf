"""Analyse a recording or a trajectory: a table of what its dynamics are, and the curves behind it."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from pipeline.analysis.chaos.zero_one import SHORTEST
from pipeline.analysis.series.embedding import Series
from pipeline.analysis.series.measure import Measured, measure
from pipeline.analysis.spectrum.estimate import pieces_of, spectrum_of
from pipeline.analysis.tabular import Row, Words, aligned, number, plain
from pipeline.layout.conventions import shown_unit
from pipeline.layout.vocabulary import told_by
from pipeline.products.product import Table

MOST_VECTORS = 4000
"""Most delay vectors that are kept for the figure."""


def series_of(ds: xr.Dataset, channel: str = "", *, seed: int = 0) -> xr.Dataset:
    """Measure what a time series says of its dynamics.

    Parameters
    ----------
    ds
        Evenly sampled variables over ``time`` [s], perhaps in several pieces: a recording (`magpend.read_recording`),
        or a trajectory (`magpend.simulate`).
    channel
        Variable; by default the first.
    seed
        Seed of the surrogates.

    Returns
    -------
    Dataset
        Over ``quantity``: ``value``, ``low`` and ``high`` (95 %), ``unit`` and ``reason``; a value that is not decided
        is NaN and has a reason. Quantities: ``delay`` (first minimum of mutual information), ``embedding_dimension``
        (false nearest neighbours), ``period`` and ``period_scatter`` (between maxima), ``cycle`` (maxima in a closed
        orbit), ``exponent`` (largest Lyapunov exponent), ``correlation_dimension``, ``zero_one`` (0-1 test),
        ``determinism``, ``laminarity``, ``mean_line``, ``line_entropy`` (recurrences) and ``surrogate_rank`` (share
        of surrogates that are predicted no worse). Attributes: ``motion`` (a word of `MOTIONS`) and ``motion_reason``.
        Curves: ``mutual_information`` over ``lag``, ``false_neighbours`` over ``dimension``, ``divergence`` over
        ``elapsed`` with ``fit_line``, ``correlation_sum`` over ``embedding`` and ``radius``, ``recurrent`` over
        ``row`` and ``column``, ``maximum`` and ``next_maximum`` over ``return``, ``vector`` over ``delayed`` and
        ``coordinate``, and ``power`` over ``bin``.

    Raises
    ------
    ValueError
        If there is no such channel, samples are not even, or no piece has 200 samples.
    """
    names = [str(name) for name, v in ds.data_vars.items() if v.ndim == 1 and v.dims == ds["time"].dims]
    channel = channel or names[0]
    if channel not in names:
        raise ValueError(f"channel {channel!r} is not there; it has {', '.join(names)}.")
    pieces, rate = pieces_of(ds, channel)
    pieces = [piece for piece in pieces if len(piece) >= SHORTEST]
    if not pieces:
        raise ValueError(f"channel {channel!r} has no {SHORTEST} samples in a row.")
    series = Series.of(pieces, 1.0 / rate)
    if not np.ptp(series.values) > 0.0:
        raise ValueError(f"channel {channel!r} is constant.")
    found = measure(series, seed)
    about = {"title": "series", "channel": channel, "unit": shown_unit(ds[channel].attrs, "1"), "seed": seed}
    power = spectrum_of(ds, channel).isel(spectrum=0).reset_coords("frequency_hz")[["power", "frequency_hz"]]
    return xr.merge([_dataset(found), power.drop_vars("order", errors="ignore")]).assign_attrs(
        {**told_by(ds.attrs), **about, "motion": found.motion[0], "motion_reason": found.motion[1]}
    )


def _dataset(found: Measured) -> xr.Dataset:
    """Return a dataset with the results and the curves of a series."""
    embedding, parted, returns = found.embedding, found.divergence, found.returns
    over = "quantity"
    variables: dict[str, Any] = {
        name: (over, np.array([getattr(r, name) for r in found.results], float)) for name in ("value", "low", "high")
    }
    variables |= {name: (over, [getattr(r, name) for r in found.results]) for name in ("unit", "reason")}
    pure, seconds = {"units": "1"}, {"units": "s"}
    variables["mutual_information"] = ("lag", found.information, pure)
    variables["false_neighbours"] = ("dimension", found.false, {"units": "1"})
    line = np.where((parted.time >= parted.fit[0]) & (parted.time <= parted.fit[1]), 1.0, np.nan)
    about = {**pure, "long_name": "mean log distance of neighbours, of random pairs 0"}
    variables["divergence"] = ("elapsed", parted.curve, about)
    variables["fit_line"] = ("elapsed", line * (parted.offset + parted.value * parted.time), pure)
    firsts = returns.pairs()
    variables["maximum"] = ("return", returns.height[firsts])
    variables["next_maximum"] = ("return", returns.height[firsts + 1])
    starts = embedding.series.starts(embedding.delay)[:MOST_VECTORS]
    pair = np.stack([embedding.series.values[starts], embedding.series.values[starts + embedding.delay]], axis=1)
    variables["vector"] = (("delayed", "coordinate"), pair)
    variables["surrogate_error"] = ("surrogate", found.surrogates[1], {"units": "1"})
    variables["prediction_error"] = ((), found.surrogates[0], {"units": "1"})
    if found.recurrence is not None:
        variables["recurrent"] = (("row", "column"), found.recurrence.matrix)
    sums = found.sums
    variables["correlation_sum"] = (("embedding", "radius"), sums.share, {"units": "1"})
    variables |= {"fit_low": ((), sums.fit[0]), "fit_high": ((), sums.fit[1])}
    coords: dict[str, Any] = {
        over: [r.name for r in found.results],
        "lag": ("lag", np.arange(len(found.information)) * found.step, seconds),
        "dimension": np.arange(1, len(found.false) + 1),
        "elapsed": ("elapsed", parted.time, seconds),
        "embedding": list(sums.dimensions),
        "radius": ("radius", sums.radius, {"units": "1"}),
    }
    if found.recurrence is not None:
        coords |= {name: (name, found.recurrence.time, seconds) for name in ("row", "column")}
    return xr.Dataset(variables, coords)


def series_table(ds: xr.Dataset) -> Table:
    """Return the table of a series.

    A row for each ``quantity``, with ``value``, ``low``, ``high``, ``unit``, ``decided`` and ``reason``.
    """
    rows: list[Row] = []
    lines: list[Words] = []
    for i, name in enumerate(ds["quantity"].values.tolist()):
        one = ds.isel(quantity=i)
        value, low, high = (float(one[key]) for key in ("value", "low", "high"))
        unit, reason = str(one["unit"].item()), str(one["reason"].item())
        row = {"quantity": name, "value": value, "low": low, "high": high, "unit": unit}
        rows.append({**row, "decided": not reason, "reason": reason})
        shown = f"{number(low, '.4g')} to {number(high, '.4g')}" if not reason else ""
        words = {"quantity": plain(name), "value": number(value, ".5g"), "95 % interval": shown}
        lines.append({**words, "unit": "" if unit == "1" else unit, "not decided because": reason})
    motion = {"quantity": "motion", "value": np.nan, "low": np.nan, "high": np.nan, "unit": str(ds.attrs["motion"])}
    decided = ds.attrs["motion"] != "not decided"
    rows.append({**motion, "decided": decided, "reason": str(ds.attrs["motion_reason"])})
    heading = f"{ds.attrs['channel']}: {ds.attrs['motion']} ({ds.attrs['motion_reason']})"
    return Table(rows, [heading, *aligned(lines)])
