"""Analyse a time series: a table of what it says of its dynamics, and the curves behind it.

A rule that all results share: a series that is not stationary, too short or too noisy gets no exponent, no dimension
and no name of its motion.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy import stats

from magpend_core.models.model import Model
from pipeline.analysis.chaos.zero_one import FEWEST_SECTIONS, zero_one_test
from pipeline.analysis.series.correlation import Sums, correlation_sums
from pipeline.analysis.series.declaration import SERIES_COLUMNS, SeriesOptions
from pipeline.analysis.series.divergence import Divergence, divergence
from pipeline.analysis.series.embedding import (
    FEW_FALSE,
    MOST_DIMENSIONS,
    N_BLOCKS,
    Embedding,
    Floats,
    Series,
    false_neighbours,
    first_minimum,
    mutual_information,
)
from pipeline.analysis.series.recurrence import Recurrence, recurrence
from pipeline.analysis.series.returns import Returns, returns_of
from pipeline.analysis.series.surrogates import N_SURROGATES, against_noise
from pipeline.analysis.spectrum.estimate import pieces_of, spectrum_of
from pipeline.analysis.spectrum.motions import channels_of, clock_of, motions_of, sampled
from pipeline.layout.columns import described
from pipeline.layout.conventions import shown_unit
from pipeline.layout.vocabulary import model_of, told_by
from pipeline.products.product import Table
from pipeline.results.intervals import binomial_interval, half_width
from pipeline.results.run import OpenRun
from pipeline.results.sets import Geometry
from pipeline.results.tabular import Row, Words, aligned, number, plain

ORDERLY, DISORDERLY = 0.15, 0.85
"""Results of the 0-1 test up to which a motion is regular, and from which on it is not."""


class Result(NamedTuple):
    """A quantity with its interval; a value that is not decided is NaN and has a reason."""

    name: str
    unit: str
    value: float = np.nan
    low: float = np.nan
    high: float = np.nan
    reason: str = ""


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
        of surrogates that are predicted no worse). Attributes: ``motion`` (not decided, periodic, regular or chaotic)
        and ``motion_reason``. Curves: ``mutual_information`` over ``lag``, ``false_neighbours`` over ``dimension``,
        ``divergence`` over ``elapsed`` with ``fit_line``, ``correlation_sum`` over ``embedding`` and ``radius``,
        ``recurrent`` over ``row`` and ``column``, ``maximum`` and ``next_maximum`` over ``return``, ``vector`` over
        ``delayed`` and ``coordinate``, and ``power`` over ``bin``.

    Raises
    ------
    ValueError
        If there is no such channel, samples are not even, no piece has 200 samples, or the model is a map.
    """
    channel, pieces, rate = pieces_of(ds, channel)
    if "model" in ds.attrs:
        refuse_map(model_of(ds), channel)
    pieces = [piece for piece in pieces if len(piece) >= FEWEST_SECTIONS]
    if not pieces:
        raise ValueError(f"channel {channel!r} has no {FEWEST_SECTIONS} samples in a row.")
    series = Series.of(pieces, 1.0 / rate)
    if not np.ptp(series.values) > 0.0:
        raise ValueError(f"channel {channel!r} is constant.")
    about = {"title": "series", "channel": channel, "unit": shown_unit(ds[channel].attrs, "1"), "seed": seed}
    power = spectrum_of(ds, channel).isel(spectrum=0).reset_coords()[["power", "frequency_hz"]]
    found = xr.merge([_measured(series, seed), power]).assign_attrs({**told_by(ds.attrs), **about})
    return described(found, SERIES_COLUMNS)


def refuse_map(model: Model, channel: str) -> None:
    """Raise ValueError if the model is a map: its series has one value per iterate and no course between them."""
    if not model.clock.is_continuous:
        raise ValueError(
            f"channel {channel!r} has one value per iterate of the map {model.name}, and delay, maxima and neighbours "
            "of a series are those of a motion that is sampled in between. Of a run of the map, analyse chaos measures "
            "exponents and the 0-1 test, and analyse dimension measures dimensions."
        )


def _measured(series: Series, seed: int) -> xr.Dataset:
    """Return all results and curves of a series."""
    per_delay = 8  # samples per delay that are kept: more are averaged
    rough, information, has_minimum = _delay_of(series)
    returns = returns_of(series, rough)
    delay = min(rough, max(1, round(returns.mean / series.step / 4))) if returns.mean > 0.0 else rough
    coarse = series.averaged(max(1, delay // per_delay))
    delay = max(1, round(delay * series.step / coarse.step))
    period = max(4, round((returns.mean / coarse.step) if returns.mean > 0.0 else 4 * delay))
    false = false_neighbours(coarse, delay, period)
    enough = np.flatnonzero(false < FEW_FALSE)
    embedding = Embedding(coarse, delay, int(enough[0]) + 1 if len(enough) else 5, period)
    parted = divergence(embedding, period, returns.in_cycle > 0)
    longest = max(coarse.pieces(), key=len)
    noise = against_noise(longest, delay, embedding.dimension, period, np.random.default_rng(seed))
    drift, leaps = _drift(coarse), _leaps(series)
    returns = replace(returns, reason=leaps) if returns.reason and leaps else returns
    parted = replace(parted, reason=leaps) if parted.reason and leaps else parted
    sums = correlation_sums(embedding, parted.grows)
    own = recurrence(embedding)
    results = [
        _delay_result(series, rough, has_minimum, leaps),
        _dimension_result(embedding, false),
        *_period_results(returns),
        _exponent_result(parted, noise, drift),
        _unless(drift or sums.reason, Result("correlation_dimension", "1", sums.value, sums.low, sums.high)),
        _zero_one_result(longest, delay, drift),
        *_recurrence_results(own),
        _surrogate_result(noise),
    ]
    motion, reason = _motion(returns, {r.name: r for r in results}, parted, drift)
    variables: dict[str, Any] = {name: ("quantity", [getattr(r, name) for r in results]) for name in Result._fields[1:]}
    lags = ("lag", np.arange(len(information)) * series.step)
    variables["mutual_information"] = ("lag", information)
    variables["false_neighbours"] = ("dimension", false)
    coords = {"quantity": [r.name for r in results], "lag": lags, "dimension": np.arange(1, len(false) + 1)}
    curves = _curves(embedding, returns, parted, sums, own)
    return xr.merge([xr.Dataset(variables, coords), curves]).assign_attrs(motion=motion, motion_reason=reason)


def _curves(
    embedding: Embedding, returns: Returns, parted: Divergence, sums: Sums, own: Recurrence | None
) -> xr.Dataset:
    """Return the curves of a series' figure."""
    most = 4000  # delay vectors that are kept for the figure
    inside = (parted.time >= parted.fit[0]) & (parted.time <= parted.fit[1])
    line = np.where(inside, parted.offset + parted.value * parted.time, np.nan)
    firsts, series = returns.pairs(), embedding.series
    starts = series.starts(embedding.delay)[:most]
    curves = {
        "divergence": ("elapsed", parted.curve),
        "fit_line": ("elapsed", line),
        "maximum": ("return", returns.height[firsts]),
        "next_maximum": ("return", returns.height[firsts + 1]),
        "vector": (("delayed", "coordinate"), series.values[starts[:, None] + [0, embedding.delay]]),
        "correlation_sum": (("embedding", "radius"), sums.share),
        "fit_low": ((), sums.fit[0]),
        "fit_high": ((), sums.fit[1]),
    }
    coords: dict[str, Any] = {
        "elapsed": ("elapsed", parted.time),
        "embedding": list(sums.dimensions),
        "radius": ("radius", sums.radius),
    }
    if own is not None:
        curves["recurrent"] = (("row", "column"), own.matrix)
        coords |= {name: (name, own.time) for name in ("row", "column")}
    return xr.Dataset(curves, coords)


def _delay_of(series: Series) -> tuple[int, Floats, bool]:
    """Return the delay [samples], the mutual information, and whether it has a minimum there.

    Without one the delay is the lag at which a fraction 1/e of the information is left.
    """
    information = mutual_information(series, min(2000, len(max(series.pieces(), key=len)) // 8))
    lag = first_minimum(information)
    if lag is not None:
        return lag, information, True
    return max(1, int(np.argmax(information < information[0] / np.e))), information, False


def _delay_result(series: Series, delay: int, decided: bool, leaps: str) -> Result:
    if not decided:
        return Result("delay", "s", reason=leaps or "mutual information has no minimum")
    parts = np.array_split(series.values, 4)
    lags = [first_minimum(mutual_information(Series.of([part], series.step), 3 * delay)) for part in parts]
    found = np.array([lag for lag in lags if lag is not None] + [delay]) * series.step
    return Result("delay", "s", delay * series.step, found.min(), found.max())


def _dimension_result(embedding: Embedding, false: Floats) -> Result:
    name, series = "embedding_dimension", embedding.series
    if not (false < FEW_FALSE).any():
        least = float(np.nanmin(false)) if np.isfinite(false).any() else np.nan
        return Result(name, "1", reason=f"{least:.1%} false neighbours are left: noise, or too few samples")
    found = [embedding.dimension]
    for half in np.array_split(series.values, 2):
        own = false_neighbours(Series.of([half], series.step), embedding.delay, embedding.theiler, 500)
        enough = np.flatnonzero(own < FEW_FALSE)
        found.append(int(enough[0]) + 1 if len(enough) else MOST_DIMENSIONS)
    return Result(name, "1", embedding.dimension, min(found), max(found))


def _period_results(returns: Returns) -> list[Result]:
    if returns.reason:
        units = {"period": "s", "period_scatter": "s", "cycle": "maxima"}
        return [Result(name, unit, reason=returns.reason) for name, unit in units.items()]
    n, cycle = len(returns.time), returns.in_cycle
    mean, low, high, scatter = (max(cycle, 1) * x for x in (returns.mean, returns.low, returns.high, returns.scatter))
    ends = (scatter * np.sqrt((n - 1) / stats.chi2.ppf(q, n - 1)) for q in (0.975, 0.025))
    found = [Result("period", "s", mean, low, high), Result("period_scatter", "s", scatter, *ends)]
    reason = "" if cycle else "maxima do not repeat"
    return [*found, _unless(reason, Result("cycle", "maxima", cycle, cycle, cycle))]


def _exponent_result(parted: Divergence, noise: tuple[float, Floats], drift: str) -> Result:
    reason = drift or parted.reason
    if not reason and parted.grows and not noise[0] < noise[1].min():
        reason = "linear noise with the same spectrum is predicted as well"
    if not reason and parted.low < 0.0 and parted.curve[-1] - parted.curve[0] >= 1.0:
        reason = "the error is larger than the exponent"
    return _unless(reason, Result("exponent", "1/s", parted.value, parted.low, parted.high))


def _unless(reason: str, result: Result) -> Result:
    """Return a result, without its values if there is a reason against it."""
    return Result(result.name, result.unit, reason=reason) if reason else result


def _zero_one_result(values: Floats, delay: int, drift: str) -> Result:
    stride = 2 * delay
    n = len(values) // stride
    if drift or n < FEWEST_SECTIONS:
        return Result("zero_one", "1", reason=drift or f"{n} samples two delays apart, fewer than {FEWEST_SECTIONS}")
    chosen = values[: n * stride : stride][:4000]
    ds = xr.Dataset({"section": (("period_index", "state"), chosen[:, None])})
    one = zero_one_test(ds, geometry=Geometry((False,), (float(values.std()),)))
    value, error = float(one["zero_one"]), 2.0 * float(one["zero_one_stderr"])
    ends = [v for v in (value - error, value + error, float(one["zero_one_half"])) if np.isfinite(v)]
    low, high = min(ends), max(ends)
    reason = "" if high < ORDERLY or low > DISORDERLY else f"{low:.2f} to {high:.2f}: neither bounded nor diffusive"
    return _unless(reason, Result("zero_one", "1", value, low, high))


def _recurrence_results(found: Recurrence | None) -> list[Result]:
    units = {"determinism": "1", "laminarity": "1", "mean_line": "s", "line_entropy": "nats"}
    if found is None:
        return [Result(name, unit, reason="too few vectors") for name, unit in units.items()]
    results = []
    for name, unit in units.items():
        value, half = found.measures[name], half_width(found.parts[name])
        most = 1.0 if name in ("determinism", "laminarity") else np.inf
        results.append(Result(name, unit, value, max(value - half, 0.0), min(value + half, most)))
    return results


def _surrogate_result(noise: tuple[float, Floats]) -> Result:
    error, others = noise
    if not np.isfinite(error):
        return Result("surrogate_rank", "1", reason="too few vectors to predict")
    n_better = int((others <= error).sum())
    low, high = binomial_interval(n_better, N_SURROGATES, confidence=0.95, method="clopper-pearson")
    return Result("surrogate_rank", "1", n_better / N_SURROGATES, float(low), float(high))


def _drift(series: Series) -> str:
    """Return why a series is not stationary: a trend of the level or the size over stretches; else an empty text."""
    # probability by chance below which a trend over the stretches counts as drift, and its least range of level or
    # size, relative to the standard deviation
    by_chance, least = 0.002, 0.1
    pieces = series.pieces()
    parts = pieces if len(pieces) >= N_BLOCKS else np.array_split(series.values, N_BLOCKS)
    for name, values in (("level", [p.mean() for p in parts]), ("size", [p.std() for p in parts])):
        relative = np.ptp(values) / series.values.std()
        if relative > least and stats.kendalltau(np.arange(len(parts)), values).pvalue < by_chance:
            return f"not stationary: its {name} drifts by {relative:.0%}"
    return ""


def _leaps(series: Series) -> str:
    """Return why a series has no course between its samples: too few to an oscillation; else an empty text.

    For a sine of n samples to a period, half of the mean squared difference of neighbours is var (1 - cos(2 pi / n)).
    """
    fewest = 6.0  # samples to an oscillation below which maxima, delays and the paths of neighbours are not seen
    steps = np.concatenate([np.diff(piece) for piece in series.pieces()])
    angle = np.arccos(max(1.0 - 0.5 * float(np.mean(steps**2)) / float(series.values.var()), -1.0))
    if angle * fewest <= 2.0 * np.pi:
        return ""
    n = 2.0 * np.pi / angle
    return f"{n:.1f} samples to an oscillation, fewer than {fewest:g}: one value per iterate or return, or noise"


def _motion(returns: Returns, results: dict[str, Result], parted: Divergence, drift: str) -> tuple[str, str]:
    """Return the name of the motion, and what it rests on or why it is not decided."""
    exponent, diffuses = results["exponent"], results["zero_one"]
    if reason := drift or exponent.reason:
        return "not decided", reason
    if parted.grows:
        if diffuses.value < ORDERLY:
            return "not decided", "the exponent is positive, but the 0-1 test finds bounded motion"
        return "chaotic", "neighbours part exponentially, and linear noise does not explain it"
    if diffuses.value > DISORDERLY:
        return "not decided", "neighbours stay close, but the 0-1 test finds diffusion"
    if returns.in_cycle:
        return "periodic", f"{returns.in_cycle} maxima repeat"
    return "regular", "neighbours stay close"


def series(run: OpenRun, options: SeriesOptions) -> xr.Dataset:
    """Sample the motion of an attractor or a cell, and measure what the series says; see `series_of`."""
    motions = motions_of(run, options)
    if len(motions) > 1:
        raise ValueError(
            f"a series is taken of one motion, and {len(motions)} are there: choose by at, attractor or cell."
        )
    (motion,) = motions
    rate = clock_of(motion)
    channel = next(v for v in channels_of(run.model) if v.name == options.channel)
    values = sampled(motion, rate, options.periods, options.samples, channels_of(run.model).index(channel))
    if values is None:
        raise ValueError("the trajectory diverges or fails: no series.")
    time = np.arange(len(values)) / (rate * options.samples)
    told = told_by(run.cube().attrs)
    ds = xr.Dataset({channel.name: ("time", values, {"units": channel.unit})}, {"time": time}, told)
    where = {name: ((), value, run.cube()[name].attrs) for name, value in motion.where.items()}
    return series_of(ds, seed=options.seed).assign_coords({**where, "attractor": motion.attractor})


def series_table(ds: xr.Dataset) -> Table:
    """Return the table of a series.

    A row for each ``quantity``, with ``value``, ``low``, ``high``, ``unit``, ``decided`` and ``reason``.
    """
    rows: list[Row] = []
    lines: list[Words] = []
    for name, *columns in zip(*(ds[key].values.tolist() for key in ("quantity", *Result._fields[1:])), strict=True):
        one = Result(name, *columns)
        rows.append(_row(one, not one.reason))
        shown = f"{number(one.low, '.4g')} to {number(one.high, '.4g')}" if not one.reason else ""
        words = {"quantity": plain(name), "value": number(one.value, ".5g"), "95 % interval": shown}
        lines.append({**words, "unit": "" if one.unit == "1" else one.unit, "not decided because": one.reason})
    motion = Result("motion", str(ds.attrs["motion"]), reason=str(ds.attrs["motion_reason"]))
    rows.append(_row(motion, motion.unit != "not decided"))
    heading = f"{ds.attrs['channel']}: {ds.attrs['motion']} ({ds.attrs['motion_reason']})"
    return Table(rows, [heading, *aligned(lines)])


def _row(one: Result, decided: bool) -> Row:
    numbers = {name: getattr(one, name) for name in ("value", "low", "high", "unit")}
    return {"quantity": one.name, **numbers, "decided": decided, "reason": one.reason}
