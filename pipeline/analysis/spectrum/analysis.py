"""Measure the spectra of the motions of a run: lines of closed orbits, and densities of motions that do not close.

A row of the result is the spectrum of one set at one parameter point, or of one cell. Lines are the harmonics of an
orbit's own period, from `pipeline.analysis.response.orbits`. Of other motions one long trajectory is sampled finely
enough that almost no power lies in the upper half of the band, where it would fold back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import xarray as xr
from scipy import signal

from pipeline.analysis.response.orbits import MOST_SAMPLED, Orbit, measures_of
from pipeline.analysis.spectrum.declaration import (
    SpectraOptions,
    SpectrumFigureOptions,
    SpectrumOptions,
    WaterfallOptions,
)
from pipeline.analysis.spectrum.estimate import TWO_FREQUENCIES, Averaged, averaged, frequencies_of, power_unit
from pipeline.analysis.spectrum.motions import (
    Motion,
    channels_of,
    clock_of,
    motions_of,
    needs_motion,
    row_axis,
    sampled,
    swept_by,
)
from pipeline.layout.conventions import code_flags
from pipeline.layout.own_words import RATE, dims_in_own_words
from pipeline.layout.vocabulary import EQUILIBRIUM, KINDS, PERIODIC_ORBIT, STABILITIES, TORUS, split_dims, told_by
from pipeline.products.product import Table
from pipeline.products.reporting import track
from pipeline.results.run import OpenRun
from pipeline.results.selection import select_points
from pipeline.results.tabular import Row, Words, aligned, number, plain, words_of
from pipeline.specification.tables import FREQUENCY

FOLDED = 1e-6
"""Share of the power in the upper half of the band, below which samples are not doubled."""

ESTIMATES = ("none", "lines", "average")
NONE, LINES, AVERAGE = range(len(ESTIMATES))
"""Values of `estimate`: a trajectory that failed, the lines of a closed orbit, an averaged periodogram."""


Array = np.ndarray


def needs_channel(run: OpenRun, options: SpectraOptions) -> None:
    """Raise ValueError unless the options name a channel, a window, and a set or a cell that can be there."""
    needs_motion(run, options)
    try:
        signal.get_window(options.window, 8)
    except ValueError as error:
        raise ValueError(f"window {options.window!r}: {error}; scipy.signal.windows lists the names.") from None


def needs_axis(run: OpenRun, options: SpectrumFigureOptions | WaterfallOptions) -> None:
    """Raise ValueError unless the run has what a figure of spectra shows: one parameter point, or one axis."""
    needs_channel(run, options)
    if options.axis == "order" and not run.model.clock.has_drive:
        raise ValueError("axis order: the model has no drive whose multiples orders could be; take Hz.")
    if isinstance(options, WaterfallOptions):
        free = [d for d in split_dims(run.cube()["status"])[0] if run.cube().sizes[d] > 1 and d not in options.at]
        if len(free) != 1:
            more = f"{len(free)} are left ({', '.join(free)}): choose values of others with --at"
            left = more if free else "none is left"
            raise ValueError(f"a waterfall is drawn along one axis, and {left}; plot spectrum draws a parameter point.")
    elif options.cell is None and not options.nearest:
        select_points(run.cube(), options.at, purpose="spectra are drawn of one parameter point or one cell")


def numbered_motions(run: OpenRun, options: SpectrumOptions) -> list[int]:
    """Return the numbers of the motions whose spectra are measured."""
    numbers = list(range(len(motions_of(run, options))))
    run.echo(f"spectrum: {len(numbers)} motions")
    return numbers


def spectrum(run: OpenRun, options: SpectrumOptions, wanted: Sequence[int]) -> xr.Dataset:
    """Measure the spectra of some motions: sets of a run, or the motion of a cell.

    Returns
    -------
    Dataset
        Over ``spectrum`` (rows) and ``bin``: ``amplitude`` of each line of a closed orbit, in the channel's unit;
        ``power`` of other motions, in unit^2/Hz or unit^2; both have the coordinates ``frequency_hz`` and, with a
        drive, ``order``. Rows have the swept parameters (``frequency``, and others under their names), ``attractor``,
        ``kind``, ``stability``, ``orbit_period``, ``share`` and ``estimate``, a code of `ESTIMATES`. Evidence:
        ``n_averages``, ``resolution_hz``, ``bandwidth_hz``; ``variance``, and ``kept``, its share in the bins; of lines
        ``error``; of a torus ``first_hz``, ``second_hz`` (NaN if undecided) and ``explained``, the share of its power
        at their combinations.
    """
    motions = motions_of(run, options, set(wanted))
    place = [v.name for v in channels_of(run.model)].index(options.channel)
    rows: list[dict[str, Any]] = [{"estimate": NONE} for _ in motions]
    closed = [i for i, m in enumerate(motions) if m.kind in (PERIODIC_ORBIT, EQUILIBRIUM)]
    for period in sorted({motions[i].period for i in closed}):
        own = [i for i in closed if motions[i].period == period]
        for i, row in zip(own, _lines([motions[i] for i in own], place, options), strict=True):
            rows[i] = row
    for i in track(sorted(set(range(len(motions))) - set(closed)), "averaging periodograms"):
        rows[i] = _average(motions[i], place, options)
    return _dataset(run, options, motions, rows)


def _lines(motions: Sequence[Motion], place: int, options: SpectrumOptions) -> list[dict[str, Any]]:
    """Measure the lines of closed orbits of one period."""
    # a limit cycle of equal samples has no period in strobes: its own is one
    orbits = [
        Orbit(m.parameters, m.state, *((1.0, 0) if m.kind == EQUILIBRIUM else (m.seconds, max(m.period, 1))))
        for m in motions
    ]
    n = options.orders * max(motions[0].period, 1)
    found = measures_of(orbits, n, of_orbit=True)
    rows: list[dict[str, Any]] = []
    for i, (motion, orbit) in enumerate(zip(motions, orbits, strict=True)):
        amplitude = np.abs(found.harmonics[i, place])
        if not np.isfinite(amplitude).all():
            rows.append({"estimate": NONE})
            continue
        variance = float(found.rms[i, place] ** 2 - found.mean[i, place] ** 2)
        at_rest = motion.kind == EQUILIBRIUM
        frequency = np.full(n, np.nan) if at_rest else np.arange(1, n + 1) / orbit.seconds
        kept = np.nan if at_rest or variance <= 0.0 else 0.5 * float((amplitude**2).sum()) / variance
        row = {"estimate": LINES, "frequency_hz": frequency, "amplitude": amplitude, "variance": max(variance, 0.0)}
        row |= {"kept": kept, "error": float(found.error[i, place]), "rate_hz": orbit.frequency_hz}
        rows.append(row)
    return rows


def _average(motion: Motion, place: int, options: SpectrumOptions) -> dict[str, Any]:
    """Average periodograms of a long trajectory; samples are doubled until almost no power folds back."""
    # samples per drive period or return of a motion that does not close: at first, and at most
    fewest, most = 128, 2048
    rate = clock_of(motion)
    n_periods = -(-options.segment * (options.averages + 1) // 2)
    n_samples = max(fewest, 1 << (8 * options.orders - 1).bit_length())
    while True:
        values = sampled(motion, rate, n_periods, n_samples, place)
        if values is None:
            return {"estimate": NONE}
        settings = {"window": options.window, "scaling": options.scaling}
        found = averaged([values], rate * n_samples, nperseg=options.segment * n_samples, **settings)
        high = found.power[len(found.power) // 2 :].sum()
        too_long = 2 * n_samples * n_periods * len(motion.state) > 8 * MOST_SAMPLED
        if high <= FOLDED * found.power.sum() or 2 * n_samples > most or too_long:
            return _row(motion, found, values, rate, n_samples, options)
        n_samples *= 2


def _row(
    motion: Motion, found: Averaged, values: Array, rate: float, n_samples: int, options: SpectrumOptions
) -> dict[str, Any]:
    n = options.orders * options.segment + 1
    row = {**asdict(found), "frequency_hz": found.frequency_hz[:n], "power": found.power[:n]}
    row |= {"estimate": AVERAGE, "rate_hz": rate}
    row["kept"] = found.power_below(n, options.scaling) / found.variance if found.variance else np.nan
    if motion.kind == TORUS:
        drive = rate if motion.parameters.model.clock.has_drive else None
        own = frequencies_of(values, rate * n_samples, drive)
        row |= {"first_hz": own.first_hz, "explained": own.share}
        row["second_hz"] = own.second_hz if own.share >= TWO_FREQUENCIES else np.nan
    return row


_NUMBERS = ("n_averages", "resolution_hz", "bandwidth_hz", "kept", "rate_hz", "first_hz", "second_hz", "explained")


def _dataset(
    run: OpenRun, options: SpectrumOptions, motions: Sequence[Motion], rows: Sequence[dict[str, Any]]
) -> xr.Dataset:
    model, cube = run.model, run.cube()
    unit = next(v.unit for v in channels_of(model) if v.name == options.channel)
    bins = max((len(row["frequency_hz"]) for row in rows if "frequency_hz" in row), default=0)
    table = {name: np.full((len(rows), bins), np.nan) for name in ("frequency_hz", "amplitude", "power")}
    for i, row in enumerate(rows):
        for name, values in table.items():
            if name in row:
                values[i, : len(row[name])] = row[name]
    over, both = ("spectrum",), ("spectrum", "bin")
    rate = np.array([row.get("rate_hz", np.nan) for row in rows])
    variables: dict[str, Any] = {
        "amplitude": (both, table["amplitude"]),
        "power": (both, table["power"], {"units": power_unit(unit, options.scaling)}),
        "estimate": (over, np.array([row["estimate"] for row in rows], np.int8), code_flags(ESTIMATES)),
        "kind": (over, np.array([m.kind for m in motions], np.int8), code_flags(KINDS)),
        "stability": (over, np.array([m.stability for m in motions], np.int8), code_flags(STABILITIES)),
        "orbit_period": (over, np.array([m.period for m in motions], np.int32)),
        "share": (over, np.array([m.share for m in motions])),
        "variance": (over, _column(rows, "variance"), {"units": power_unit(unit, "spectrum")}),
        "error": (over, _column(rows, "error")),
        **{name: (over, _column(rows, name)) for name in _NUMBERS},
    }
    coords: dict[str, Any] = {
        "frequency_hz": (both, table["frequency_hz"]),
        "attractor": (over, np.array([m.attractor for m in motions], np.int32)),
    }
    if model.clock.has_drive:
        coords["order"] = (both, table["frequency_hz"] / rate[:, None])
    coords |= {str(k): v for k, v in cube.coords.items() if not v.ndim and v.dtype.kind == "f"}
    for name in motions[0].where:
        coords[row_axis(name)] = (over, np.array([m.where[name] for m in motions]), dict(cube[name].attrs))
    attrs = {"title": "spectra", "channel": options.channel, "unit": unit, "scaling": options.scaling}
    attrs |= {"window": options.window, "axes": " ".join(map(row_axis, motions[0].where)), **told_by(cube.attrs)}
    return xr.Dataset(variables, coords, attrs)


def _column(rows: Sequence[dict[str, Any]], name: str) -> Array:
    return np.array([row.get(name, np.nan) for row in rows], float)


def axes_of(ds: xr.Dataset) -> list[str]:
    """Return the names of the coordinates that hold the swept parameters of each row."""
    return list(dims_in_own_words(str(ds.attrs.get("axes", "")).split(), str(ds.attrs.get(RATE, FREQUENCY))))


_EVIDENCE = ("variance", "kept", "n_averages", "resolution_hz", "bandwidth_hz", "error")
_EVIDENCE_OF_TORI = ("first_hz", "second_hz", "explained")


def spectrum_table(ds: xr.Dataset) -> Table:
    """Return the table of spectra, of a run or from `magpend.spectrum_of`.

    Rows are bins: swept parameters, ``attractor_id``, ``kind``, ``stability``,
    ``estimate``, ``frequency_hz``, ``order`` (with a drive), ``amplitude``, ``power``, and the evidence of the whole
    spectrum. The text has a line for each spectrum.
    """
    coded = {name: words_of(ds[name]) for name in ("kind", "stability", "estimate") if name in ds}
    rows: list[Row] = []
    lines: list[Words] = []
    for i in range(ds.sizes["spectrum"]):
        one = ds.isel(spectrum=i).load()
        head: Row = {name: float(one[name]) for name in axes_of(ds)}
        head |= {"attractor_id": int(one["attractor"])} if "attractor" in one.coords else {}
        head |= {name: words[int(one[name])] for name, words in coded.items()}
        evidence = {name: float(one[name]) for name in (*_EVIDENCE, *_EVIDENCE_OF_TORI) if name in one}
        names = [name for name in ("frequency_hz", "order", "amplitude", "power") if name in one.variables]
        for values in zip(*(one[name].values.tolist() for name in names), strict=True):
            if np.isfinite(values[0]):
                rows.append({**head, **dict(zip(names, values, strict=True)), **evidence})
        lines.append(_words(one, head))
    unit = str(ds.attrs["unit"])
    heading = f"spectrum of {ds.attrs['channel']}" + ("" if unit == "1" else f" [{unit}]")
    return Table(rows, [heading, *aligned(lines), *str(ds.attrs.get("notes", "")).splitlines()])


def _words(one: xr.Dataset, head: Row) -> Words:
    most = 4  # lines, the largest ones, that the printed table names
    column, unit = ("order", "") if "order" in one.coords else ("frequency_hz", " Hz")
    is_average = head.get("estimate", "average") == "average"
    values = np.nan_to_num(one["power" if is_average else "amplitude"].values)
    places = signal.find_peaks(values, distance=3)[0] if is_average else np.flatnonzero(values)
    best = places[np.argsort(-values[places], kind="stable")][:most]
    largest = ", ".join(f"{values[k]:.4g} at {float(one[column][k]):.5g}{unit}" for k in best)

    def told(name: str, form: str) -> str | None:
        return number(float(one[name]), form) if name in one else None

    return {
        **{swept_by(key): f"{value:.6g}" for key, value in head.items() if isinstance(value, float)},
        "id": (str(head["attractor_id"]) if head["attractor_id"] >= 0 else "-") if "attractor_id" in head else None,
        **{key: plain(str(head[key])) for key in ("kind", "stability", "estimate") if key in head},
        "largest": largest or "-",
        "averages": told("n_averages", ".0f"),
        "resolution [Hz]": told("resolution_hz", ".4g"),
        "second [Hz]": told("second_hz", ".7g") if head.get("kind") == "torus" else None,
        "kept": told("kept", ".4f"),
    }
