"""Measure what a time series says of its dynamics, each result with an interval or the reason why it is not decided.

A rule that all results share: a series that is not stationary, too short or too noisy gets no exponent, no dimension
and no name of its motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from scipy import stats

from pipeline.analysis.chaos.zero_one import SHORTEST, zero_one_test
from pipeline.analysis.series.correlation import Sums, correlation_sums
from pipeline.analysis.series.divergence import Divergence, divergence
from pipeline.analysis.series.embedding import (
    FEW_FALSE,
    MOST_DIMENSIONS,
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
from pipeline.analysis.sets import Geometry

PER_DELAY = 8
"""Samples per delay that are kept: more are averaged."""

N_SEGMENTS = 8
"""Stretches of a series that are compared."""

DRIFT = 0.002
"""Probability by chance below which a trend over the stretches counts as drift."""

LEAST_DRIFT = 0.1
"""Least range of level or size over the stretches that counts as drift, relative to the standard deviation."""

ORDERLY, DISORDERLY = 0.15, 0.85
"""Results of the 0-1 test up to which a motion is regular, and from which on it is not."""

MOTIONS = ("not decided", "periodic", "regular", "chaotic")


@dataclass(frozen=True)
class Result:
    """A quantity with its interval; a value that is not decided is NaN and has a reason."""

    name: str
    value: float
    low: float
    high: float
    unit: str
    reason: str = ""

    @classmethod
    def undecided(cls, name: str, unit: str, reason: str) -> Result:
        """Return a result that is not decided."""
        return cls(name, np.nan, np.nan, np.nan, unit, reason)

    @classmethod
    def of_parts(cls, name: str, value: float, parts: Sequence[float], unit: str) -> Result:
        """Return a result with Student's interval of the mean from its values in parts of the series."""
        half = float(stats.t.ppf(0.975, len(parts) - 1) * np.std(parts, ddof=1) / np.sqrt(len(parts)))
        return cls(name, value, value - half, value + half, unit)


@dataclass(frozen=True)
class Measured:
    """Everything that is measured of a series."""

    step: float  # sampling interval [s]
    information: Floats
    false: Floats
    returns: Returns
    embedding: Embedding
    divergence: Divergence
    sums: Sums
    recurrence: Recurrence | None
    surrogates: tuple[float, Floats]
    results: list[Result]
    motion: tuple[str, str]  # name and reason


def measure(series: Series, seed: int) -> Measured:
    """Measure all quantities of a series, see `pipeline.analysis.series.analysis.series_of`."""
    rough = _delay_of(series)
    returns = returns_of(series, rough[0])
    delay = min(rough[0], max(1, round(returns.mean / series.step / 4))) if returns.mean > 0.0 else rough[0]
    coarse = series.averaged(max(1, delay // PER_DELAY))
    delay = max(1, round(delay * series.step / coarse.step))
    period = max(4, round((returns.mean / coarse.step) if returns.mean > 0.0 else 4 * delay))
    false = false_neighbours(coarse, delay, period)
    enough = np.flatnonzero(false < FEW_FALSE)
    embedding = Embedding(coarse, delay, int(enough[0]) + 1 if len(enough) else 5, period)
    parted = divergence(embedding, period, returns.in_cycle > 0)
    longest = max(coarse.pieces(), key=len)
    noise = against_noise(longest, delay, embedding.dimension, period, np.random.default_rng(seed))
    drift = _drift(coarse)
    sums = correlation_sums(embedding, parted.grows)
    own = recurrence(embedding)
    results = [
        _delay_result(series, *rough),
        _dimension_result(coarse, embedding, false),
        *_period_results(returns),
        _exponent_result(parted, noise, drift),
        _dimension_of(sums, drift),
        _zero_one_result(longest, delay, drift),
        *_recurrence_results(own),
        _surrogate_result(noise),
    ]
    motion = _motion(returns, {r.name: r for r in results}, parted, drift)
    return Measured(series.step, rough[1], false, returns, embedding, parted, sums, own, noise, results, motion)


def _delay_of(series: Series) -> tuple[int, Floats, bool]:
    """Return the delay [samples], the mutual information, and whether it has a minimum there.

    Without one the delay is the lag at which a fraction 1/e of the information is left.
    """
    information = mutual_information(series, min(2000, len(max(series.pieces(), key=len)) // 8))
    lag = first_minimum(information)
    if lag is not None:
        return lag, information, True
    return max(1, int(np.argmax(information < information[0] / np.e))), information, False


def _delay_result(series: Series, delay: int, information: Floats, decided: bool) -> Result:
    if not decided:
        return Result.undecided("delay", "s", "mutual information has no minimum")
    parts = np.array_split(series.values, 4)
    lags = [first_minimum(mutual_information(Series.of([part], series.step), 3 * delay)) for part in parts]
    found = [lag for lag in lags if lag is not None] + [delay]
    return Result("delay", delay * series.step, min(found) * series.step, max(found) * series.step, "s")


def _dimension_result(series: Series, embedding: Embedding, false: Floats) -> Result:
    name = "embedding_dimension"
    if not (false < FEW_FALSE).any():
        least = float(np.nanmin(false)) if np.isfinite(false).any() else np.nan
        return Result.undecided(name, "1", f"{least:.1%} false neighbours are left: noise, or too few samples")
    halves = [Series.of([part], series.step) for part in np.array_split(series.values, 2)]
    found = [embedding.dimension]
    for half in halves:
        enough = np.flatnonzero(false_neighbours(half, embedding.delay, embedding.theiler, 500) < FEW_FALSE)
        found.append(int(enough[0]) + 1 if len(enough) else MOST_DIMENSIONS)
    return Result(name, float(embedding.dimension), float(min(found)), float(max(found)), "1")


def _period_results(returns: Returns) -> list[Result]:
    if returns.reason:
        return [Result.undecided(name, u, returns.reason) for name, u in (("period", "s"), ("period_scatter", "s"))]
    n = len(returns.time)
    low, high = (returns.scatter * np.sqrt((n - 1) / stats.chi2.ppf(q, n - 1)) for q in (0.975, 0.025))
    scatter = Result("period_scatter", returns.scatter, float(low), float(high), "s")
    period = Result("period", returns.mean, returns.low, returns.high, "s")
    if not returns.in_cycle:
        return [period, scatter]
    return [period, scatter, Result("cycle", float(returns.in_cycle), returns.in_cycle, returns.in_cycle, "maxima")]


def _exponent_result(parted: Divergence, noise: tuple[float, Floats], drift: str) -> Result:
    reason = drift or parted.reason
    if not reason and parted.grows and not noise[0] < noise[1].min():
        reason = "linear noise with the same spectrum is predicted as well"
    if not reason and parted.low < 0.0 and parted.curve[-1] - parted.curve[0] >= 1.0:
        reason = "the error is larger than the exponent"
    if reason:
        return Result.undecided("exponent", "1/s", reason)
    return Result("exponent", parted.value, parted.low, parted.high, "1/s")


def _dimension_of(sums: Sums, drift: str) -> Result:
    reason = drift or sums.reason
    if reason:
        return Result.undecided("correlation_dimension", "1", reason)
    return Result("correlation_dimension", sums.value, sums.low, sums.high, "1")


def _zero_one_result(values: Floats, delay: int, drift: str) -> Result:
    name = "zero_one"
    stride = 2 * delay
    n = len(values) // stride
    if drift or n < SHORTEST:
        return Result.undecided(name, "1", drift or f"{n} samples two delays apart, fewer than {SHORTEST}")
    chosen = values[: n * stride : stride][:4000]
    ds = xr.Dataset({"section": (("period_index", "state"), chosen[:, None])})
    one = zero_one_test(ds, geometry=Geometry((False,), (float(values.std()),)))
    value, error = float(one["zero_one"]), 2.0 * float(one["zero_one_stderr"])
    half = float(one["zero_one_half"])
    ends = [v for v in (value - error, value + error, half) if np.isfinite(v)]
    if not (max(ends) < ORDERLY or min(ends) > DISORDERLY):
        return Result.undecided(name, "1", f"{min(ends):.2f} to {max(ends):.2f}: neither bounded nor diffusive")
    return Result(name, value, min(ends), max(ends), "1")


def _recurrence_results(found: Recurrence | None) -> list[Result]:
    units = {"determinism": "1", "laminarity": "1", "mean_line": "s", "line_entropy": "nats"}
    if found is None:
        return [Result.undecided(name, unit, "too few vectors") for name, unit in units.items()]
    results = [Result.of_parts(name, found.measures[name], found.parts[name], unit) for name, unit in units.items()]
    # shares lie in 0 to 1, the others above 0
    return [
        replace(r, low=max(r.low, 0.0), high=min(r.high, 1.0) if r.name in ("determinism", "laminarity") else r.high)
        for r in results
    ]


def _surrogate_result(noise: tuple[float, Floats]) -> Result:
    error, others = noise
    if not np.isfinite(error):
        return Result.undecided("surrogate_rank", "1", "too few vectors to predict")
    n_better = int((others <= error).sum())
    low, high = stats.beta.ppf(
        [0.025, 0.975], [n_better, n_better + 1], [N_SURROGATES - n_better + 1, N_SURROGATES - n_better]
    )
    return Result(
        "surrogate_rank", n_better / N_SURROGATES, float(np.nan_to_num(low)), float(np.nan_to_num(high, nan=1.0)), "1"
    )


def _drift(series: Series) -> str:
    """Return why a series is not stationary: a trend of the level or the size over stretches; else an empty text."""
    pieces = series.pieces()
    parts = pieces if len(pieces) >= N_SEGMENTS else np.array_split(series.values, N_SEGMENTS)
    for name, values in (("level", [p.mean() for p in parts]), ("size", [p.std() for p in parts])):
        relative = np.ptp(values) / series.values.std()
        if relative > LEAST_DRIFT and stats.kendalltau(np.arange(len(parts)), values).pvalue < DRIFT:
            return f"not stationary: its {name} drifts by {relative:.0%}"
    return ""


def _motion(returns: Returns, results: dict[str, Result], parted: Divergence, drift: str) -> tuple[str, str]:
    """Return the name of the motion, and what it rests on or why it is not decided."""
    exponent, diffuses = results["exponent"], results["zero_one"]
    if drift:
        return MOTIONS[0], drift
    if exponent.reason:
        return MOTIONS[0], exponent.reason
    if parted.grows:
        if diffuses.value < ORDERLY:
            return MOTIONS[0], "the exponent is positive, but the 0-1 test bounded"
        return MOTIONS[3], "neighbours part exponentially, and linear noise does not explain it"
    if diffuses.value > DISORDERLY:
        return MOTIONS[0], "neighbours stay close, but the 0-1 test diffuses"
    if returns.in_cycle:
        return MOTIONS[1], f"{returns.in_cycle} maxima repeat"
    return MOTIONS[2], "neighbours stay close"
