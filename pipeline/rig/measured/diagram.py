"""Measure a bifurcation diagram: section points, period and class of motion at each frequency of recorded sweeps.

A motion of period k repeats every k sections, up to noise and the rest of a transient. Second differences at
lag k, x[n + 2k] - 2 x[n + k] + x[n], suppress a transient: if it decays by a factor m per k sections, they
keep the fraction (1 - m)^2 of it, while first differences keep 1 - m. In units of the sections' own noise
their root mean square is 1 for a motion of period k, and as large as the motion for any other. The least k
with a small value is the period. Its confidence is the fraction of resampled sections, with limits between
half and twice the chosen one, that give the same period.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from magpend_core.models.model import Model, Parameters
from pipeline.layout.vocabulary import model_attribute, model_of
from pipeline.products.product import Table
from pipeline.results.sides import UNKNOWN, flags_of
from pipeline.results.tabular import Row, Words, aligned, counted, number, values
from pipeline.rig.edges import Edges, edges_of
from pipeline.rig.measured.declaration import MAX_PERIOD, SweepOptions
from pipeline.rig.measured.sections import find_sections, name_of, section_phase
from pipeline.rig.measured.steps import LEAST_STRETCH, Stretch, cut
from pipeline.specification.problems import SpecError

# ---- periods ---------------------------------------------------------------------------------------

Floats = npt.NDArray[np.float64]

LIMIT = 2.5
"""Root mean square of second differences, in units of noise, below which a motion is closed."""
_LEAST = 6
"""Fewest second differences that decide on a period."""


@dataclass(frozen=True)
class Regime:
    """The estimated period of a motion, with its confidence."""

    orbit_period: int  # period in drive periods; 0 if the motion closes at no tested period
    confidence: float  # fraction of resamples that give the same period, 0 to 1
    # root mean square of the second differences at that period, in units of noise. Without a period, the least over all
    # tested periods.
    closure: float
    # ratio by which the decision clears the limit: the least of closure/limit over all shorter periods, and of
    # limit/closure at this period. Without a period, the least closure/limit.
    margin: float
    max_period: int


def find_period(points: Floats, noise: Floats, *, max_period: int = MAX_PERIOD) -> Regime:
    """Estimate the period of a motion from consecutive noisy section points, (n, component), angles not wrapped.

    A full turn per period is a trend, which cancels in second differences. A period k needs 2 k + 6 sections; with
    fewer than 8 sections, the period is 0 with confidence 0.
    """
    n = len(points)
    periods = [k for k in range(1, max_period + 1) if n - 2 * k >= _LEAST]
    if not periods:
        return Regime(0, 0.0, np.inf, 0.0, 0)
    squares = np.full((len(periods), n), np.nan)
    for row, k in enumerate(periods):
        squares[row, : n - 2 * k] = _second(points, noise, k)
    closure = _closure(squares)
    found = _least(closure, LIMIT)
    share = _share(squares, found)
    if found < 0:
        best = float(closure.min())
        return Regime(0, share, best, best / LIMIT, periods[-1])
    rivals = closure[:found] / LIMIT
    margin = min(LIMIT / float(closure[found]), float(rivals.min()) if found else np.inf)
    return Regime(periods[found], share, float(closure[found]), margin, periods[-1])


def _second(points: Floats, noise: Floats, k: int) -> Floats:
    """Return squared second differences of section points at lag `k` in units of noise, averaged over states."""
    difference = points[2 * k :] - 2 * points[k:-k] + points[: -2 * k]
    variance = noise[2 * k :] ** 2 + 4 * noise[k:-k] ** 2 + noise[: -2 * k] ** 2
    return np.asarray((difference**2 / variance).mean(axis=1))


def _closure(squares: Floats) -> Floats:
    """Return for each period the rms second difference: of all points or of the later half, the smaller."""
    known = np.isfinite(squares)
    values = np.where(known, squares, 0.0)
    later = np.zeros(squares.shape[1], bool)
    later[squares.shape[1] // 2 :] = True
    # a lag whose later half is too short is judged by all sections
    found = []
    for chosen in (np.ones_like(later), later):
        count = (known & chosen).sum(axis=1)
        mean = (values * chosen).sum(axis=1) / np.maximum(count, 1)
        found.append(np.where(count >= _LEAST, mean, np.inf))
    return np.asarray(np.sqrt(np.minimum(*found)))


def _least(closure: Floats, limit: float) -> int:
    """Return the index of the least tested period at which the motion closes, or -1 if it closes at none."""
    closed = np.flatnonzero(closure <= limit)
    return int(closed[0]) if closed.size else -1


def _share(squares: Floats, found: int) -> float:
    """Return the fraction of bootstrap resamples of the section points that give the same period as all points do.

    Sections are drawn in blocks as long as second differences overlap, for all lags together. The limit is
    drawn log-uniformly between half and twice the chosen one, since the noise is known only to about a factor
    of two.
    """
    n_resamples = 200
    n, rng = squares.shape[1], np.random.default_rng(0)
    block = min(max(4, squares.shape[0]), n)
    number = -(-n // block)
    same = 0
    for _ in range(n_resamples):
        begins = rng.integers(0, n, number)
        chosen = (begins[:, None] + np.arange(block)).ravel() % n
        closure = _closure(squares[:, np.sort(chosen)])
        same += _least(closure, LIMIT * 2.0 ** rng.uniform(-1, 1)) == found
    return same / n_resamples


# ---- diagram ---------------------------------------------------------------------------------------

_PARTS = ("section", "section_noise", "kink")
DIRECTIONS = {1: "up", -1: "down", 0: "none"}


@dataclass(frozen=True)
class _Step:
    """Frequency step of a measured diagram: its section points, their noise, and the period of the motion."""

    stretch: Stretch
    recording: int
    state: tuple[str, ...]
    section: np.ndarray
    noise: np.ndarray
    regime: Regime


def measure(
    recordings: Sequence[xr.Dataset], options: SweepOptions | None = None, *, parameters: Parameters | None = None
) -> xr.Dataset:
    """Return section points, period and class of motion at each frequency step of one or more recorded sweeps of one
    model.

    Without `parameters`, motions are not classified. The dims are ``step``, ``period_index`` (NaN beyond a step's own)
    and ``state``. ``section`` and ``section_noise`` (step, period_index, state) have angles not wrapped; by step there
    are ``frequency_error_hz``, ``jitter_s``, ``duty_cycle``, ``duty_cycle_error``, ``instant_error_s`` (shared by all
    its sections: it shifts angles by their rates and is not included in ``section_noise``), ``n_sections``, the fields
    of `Regime`, and ``side`` (codes of the model's classifier). Coordinates of ``step``: ``frequency`` [Hz],
    ``direction`` (up, down, none), ``recording``, ``start_s``, ``end_s``.

    Raise `SpecError` for recordings of different models or states, without a drive, without a stretch of one frequency
    or without sections.
    """
    options = options or SweepOptions()
    models = sorted({model_of(r) for r in recordings}, key=lambda model: model.name)
    if len(models) != 1:
        raise SpecError(
            f"recordings: their models are {', '.join(m.name for m in models) or 'none'}; a diagram is drawn of "
            "one: give recordings whose mappings name the same model."
        )
    (model,) = models
    known = model.load() if parameters is None else parameters
    steps = [step for i, r in enumerate(recordings) for step in _steps(r, i, options, known)]
    _check(steps, recordings)
    found = _dataset(steps, model, recordings)
    return found if parameters is None else with_sides(found, parameters)


def _steps(recording: xr.Dataset, number: int, options: SweepOptions, parameters: Parameters) -> list[_Step]:
    model = parameters.model
    edges = edges_of(recording, hysteresis=options.hysteresis)
    stretches = cut(edges, transient=options.transient, window=options.window)
    instants = _instants(edges, stretches, section_phase(parameters, stretches[0].timing.frequency_hz))
    sections = find_sections(recording, instants, window_s=options.window_s)
    names = tuple(str(n) for n in sections["state"].values)
    scale = np.array([model.state(n).scale for n in names])
    section, noise, kink = (_in_place(sections, n, instants.rising.size) for n in _PARTS)
    found, first = [], 0
    for stretch in stretches:
        own = slice(first, first + stretch.edges.rising.size)
        first = own.stop
        kept = np.flatnonzero(np.isfinite(section[own]).all(axis=1))
        if kept.size < LEAST_STRETCH:
            continue
        inner = slice(own.start + int(kept[0]), own.start + int(kept[-1]) + 1)
        points = section[inner]
        blur = _with_instants(points, noise[inner], names, model, stretch.instant_scatter_s)
        shaken = _shaken(points, blur, np.abs(kink[inner]), names, model, stretch.shake_s)
        regime = find_period(points / scale, shaken / scale, max_period=options.max_period)
        found.append(_Step(stretch, number, names, points, blur, regime))
    return found


def _instants(edges: Edges, stretches: Sequence[Stretch], phase: float) -> Edges:
    """Return the times at which section points are taken: rising edges of the drive, or a fixed phase after them."""
    later = [s.edges.rising + phase / s.timing.frequency_hz for s in stretches]
    # windows end at the other edges of the drive; for sections at another phase, at all edges
    others = np.sort(np.concatenate([edges.rising, edges.falling])) if phase else edges.falling
    return Edges(np.concatenate(later), others, edges.resolution_s)


def _in_place(sections: xr.Dataset, name: str, n: int) -> np.ndarray:
    values = np.full((n, sections.sizes["state"]), np.nan)
    values[sections["number"].values] = sections[name].values
    return values


def _with_instants(
    points: np.ndarray, noise: np.ndarray, names: tuple[str, ...], model: Model, scatter_s: float
) -> np.ndarray:
    """Return the noise of section points, with the effect of their uncertain times where rates are measured."""
    both = noise.copy()
    for i, name in enumerate(names):
        rate = model.state(name).rate
        if rate in names:
            both[:, i] = np.hypot(noise[:, i], points[:, names.index(rate)] * scatter_s)
    return both


def _shaken(
    points: np.ndarray, noise: np.ndarray, kink: np.ndarray, names: tuple[str, ...], model: Model, shake_s: float
) -> np.ndarray:
    """Return the expected scatter of a periodic motion: sensor noise, and the effect of drive edges that come early or
    late.

    A late edge lets an angle advance by its rate times the delay. It changes a rate by the jump of the rate's
    derivative times the delay.
    """
    # scatter of a jittered motion relative to the effect of one edge: each period has two, and effects last
    memory = 3.0
    if not shake_s:
        return noise
    both = noise.copy()
    for i, name in enumerate(names):
        rate = model.state(name).rate
        change = np.abs(points[:, names.index(rate)]) if rate in names else np.nanmedian(kink[:, i])
        both[:, i] = np.hypot(noise[:, i], memory * np.nan_to_num(change) * shake_s)
    return both


def _check(steps: Sequence[_Step], recordings: Sequence[xr.Dataset]) -> None:
    if not steps:
        names = ", ".join(name_of(r) for r in recordings)
        raise SpecError(
            f"{names}: no stretch of one frequency holds {LEAST_STRETCH} sections; choose longer recordings, a "
            "smaller transient, or a window of a slow sweep."
        )
    states = sorted({", ".join(s.state) for s in steps})
    if len(states) > 1:
        raise SpecError(f"recordings: they hold different states ({'; '.join(states)}); map the same channels of all.")


def _dataset(steps: Sequence[_Step], model: Model, recordings: Sequence[xr.Dataset]) -> xr.Dataset:
    length = max(len(s.section) for s in steps)
    section, noise = (np.full((len(steps), length, len(steps[0].state)), np.nan) for _ in range(2))
    for i, step in enumerate(steps):
        section[i, : len(step.section)] = step.section
        noise[i, : len(step.section)] = step.noise
    dims = ("step", "period_index", "state")
    about = {"units": "see state_units", "long_name": "state at the rising edge"}
    timing, regime = [s.stretch.timing for s in steps], [s.regime for s in steps]
    rows = {
        "frequency_error_hz": ([t.frequency_error_hz for t in timing], "Hz", "standard error of the frequency"),
        "jitter_s": ([t.jitter_s for t in timing], "s", "scatter of the rising edges"),
        "duty_cycle": ([t.duty_cycle for t in timing], "1", "share of the period in the high state"),
        "duty_cycle_error": ([t.duty_cycle_error for t in timing], "1", "standard error of the duty cycle"),
        "instant_error_s": (
            [s.stretch.instant_error_s for s in steps],
            "s",
            "error that the instants of all sections share",
        ),
        "n_sections": ([len(s.section) for s in steps], "1", "sections"),
        "orbit_period": ([r.orbit_period for r in regime], "1", "period in drive periods, 0: unclosed"),
        "confidence": ([r.confidence for r in regime], "1", "share of resamples with this period"),
        "closure": ([r.closure for r in regime], "1", "second differences in units of noise"),
        "margin": ([r.margin for r in regime], "1", "ratio by which the nearest rival misses"),
    }
    found = xr.Dataset(
        {
            "section": (dims, section, about),
            "section_noise": (dims, noise, {**about, "long_name": "noise of the state at the rising edge"}),
            **{k: ("step", np.array(v), {"units": u, "long_name": n}) for k, (v, u, n) in rows.items()},
        },
        coords={
            "frequency": ("step", [t.frequency_hz for t in timing], _about("Hz", "drive frequency")),
            "direction": ("step", [DIRECTIONS[s.stretch.direction] for s in steps]),
            "recording": ("step", [s.recording for s in steps]),
            "start_s": ("step", [s.stretch.start_s for s in steps], _about("s", "first edge")),
            "end_s": ("step", [s.stretch.end_s for s in steps], _about("s", "last edge")),
            "state": list(steps[0].state),
            "state_units": ("state", [model.state(n).unit for n in steps[0].state]),
        },
    )
    files = [{"file": name_of(r), "sha256": str(r.attrs.get("sha256", ""))} for r in recordings]
    simulated = any(int(r.attrs.get("simulated", 0)) for r in recordings)
    return found.assign_attrs(
        title="measured diagram", model=model_attribute(model), simulated=int(simulated), recordings=json.dumps(files)
    )


def _about(units: str, text: str) -> dict[str, str]:
    return {"units": units, "long_name": text}


def with_sides(measured: xr.Dataset, parameters: Parameters) -> xr.Dataset:
    """Add the class of motion (``side``) of each frequency step, by the model's classifier with given parameters.

    Without a classifier, or with a state unknown, nothing is added.
    """
    model = parameters.model
    classifier = model.classifier
    if classifier is None or tuple(measured["state"].values) != model.state_names:
        return measured
    codes = np.full(measured.sizes["step"], UNKNOWN, np.int8)
    angles = np.array(model.is_angle)
    for i in range(measured.sizes["step"]):
        points = measured["section"].values[i]
        points = points[np.isfinite(points).all(axis=1)]
        turns = np.round((points[-1] - points[0])[angles] / (2 * np.pi)).astype(np.int64)
        wrapped = np.where(angles, np.pi - np.mod(np.pi - points, 2 * np.pi), points)
        codes[i] = classifier.classify(wrapped, turns, measured["frequency"].values[i], parameters)
    return measured.assign(side=("step", codes, flags_of(classifier)))


def steps_table(measured: xr.Dataset) -> Table:
    """Return a table of the frequency steps, with the comparison with a computed run if there is one."""
    rows = [_row(measured.isel(step=i)) for i in range(measured.sizes["step"])]
    return Table(rows, [counted(len(rows), "step"), *aligned([_words(r) for r in rows])])


_MEASURED = ("frequency_error_hz", "direction", "recording", "start_s", "jitter_s", "duty_cycle", "duty_cycle_error")


_ORBIT = ("n_sections", "orbit_period", "confidence", "closure", "side")


_NEAREST = ("distance", "distance_in_noise", "runner_up", "noise_floor", "winner")


_COMPUTED = ("computed_period", "same_period", "same_side")


def _row(one: xr.Dataset) -> Row:
    labelled = ("computed_side",) if model_of(one).classifier else ()
    names = (*_MEASURED, *_ORBIT, *_NEAREST, *_COMPUTED, *labelled)
    return {"frequency_hz": float(one["frequency"]), **values(one, *names)}


def _words(row: Row) -> Words:
    error = row["frequency_error_hz"]
    digits = int(np.clip(1 - math.floor(math.log10(error)), 0, 8)) if 0 < error < 1 else 6
    words = {
        "frequency Hz": f"{row['frequency_hz']:.{digits}f} ± {error:.{digits}f}",
        "way": row["direction"],
        "jitter ms": number(1e3 * row["jitter_s"], ".3f"),
        "duty cycle": f"{row['duty_cycle']:.5f} ± {row['duty_cycle_error']:.5f}",
        "sections": str(row["n_sections"]),
        "period": str(row["orbit_period"] or "-"),
        "sure": f"{row['confidence']:.2f}",
        "side": row.get("side"),
    }
    if "winner" not in row:
        return words
    nobody = row["winner"] < 0
    return words | {
        "nearest": "-" if nobody else str(row["winner"]),
        "its period": "-" if nobody else str(row["computed_period"] or "-"),
        "its side": "-" if nobody and "computed_side" in row else row.get("computed_side"),
        "distance": number(row["distance"], ".4f"),
        "in noise": number(row["distance_in_noise"], ".2f"),
        "next": number(row["runner_up"], ".4f"),
    }
