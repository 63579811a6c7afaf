"""Estimate spectra of time series: averaged periodograms, and the frequencies of the lines of a torus."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy import optimize, signal

from pipeline.analysis.spectrum.declaration import SPECTRUM_COLUMNS
from pipeline.analysis.spectrum.gaps import Filled, filled
from pipeline.layout.columns import described
from pipeline.layout.conventions import shown_unit
from pipeline.layout.vocabulary import told_by

LOBE = 4
"""Half width of a line in bins, of the window by which lines are told apart (Blackman-Harris, side lobes at -92 dB)."""


TWO_FREQUENCIES = 0.99
"""Share of the power in combinations of two frequencies from which on a motion is said to have these two."""

Array = np.ndarray


@dataclass(frozen=True)
class Settings:
    """Numbers by which the length of segments is chosen."""

    segments: int = 16
    """Segments without overlap into which a series is divided: more smooth the noise, fewer resolve closer lines."""
    kept: float = 0.9
    """Share of the variance that the bins hold at least: where they hold less, segments are too short for the slowest
    motion, and are lengthened up to the longest stretch."""


@dataclass(frozen=True)
class Averaged:
    """An averaged periodogram, with its resolution."""

    frequency_hz: Array  # of the bins, from 0 to half of the sampling rate
    power: Array  # per hertz, or of each bin
    n_averages: int  # segments
    resolution_hz: float  # distance of two bins
    bandwidth_hz: float  # equivalent noise bandwidth of the window: power per hertz times this is power
    variance: float  # of the series, about its mean

    def power_below(self, n_bins: int, scaling: str) -> float:
        """Return the power in the first bins, whatever the scaling: the integral of the density."""
        width = self.resolution_hz * (1.0 if scaling == "density" else 1.0 / self.bandwidth_hz)
        return float(self.power[:n_bins].sum() * width)

    def kept(self, scaling: str) -> float:
        """Return the share of the variance that lies in the bins."""
        return self.power_below(len(self.power), scaling) / self.variance if self.variance else np.nan


def averaged(pieces: Sequence[Array], rate_hz: float, *, window: str, nperseg: int, scaling: str) -> Averaged:
    """Average the periodograms of segments that overlap by half, as `scipy.signal.welch`, over pieces of a series.

    Each piece has at least `nperseg` even samples. Segments of all pieces have equal weight.
    """
    counts = [1 + (len(piece) - nperseg) // (nperseg - nperseg // 2) for piece in pieces]
    settings = {"fs": rate_hz, "window": window, "nperseg": nperseg, "scaling": scaling}
    found = [signal.welch(piece, **settings) for piece in pieces]
    weights = signal.get_window(window, nperseg)
    return Averaged(
        found[0][0],
        np.average([power for _, power in found], axis=0, weights=counts),
        sum(counts),
        rate_hz / nperseg,
        float(rate_hz * (weights**2).sum() / weights.sum() ** 2),
        float(np.concatenate(pieces).var()),
    )


@dataclass(frozen=True)
class Frequencies:
    """The two frequencies of a torus [Hz], and the share of its power at their combinations."""

    first_hz: float
    second_hz: float
    share: float


def frequencies_of(values: Array, rate_hz: float, drive_hz: float | None = None) -> Frequencies:
    """Return the two frequencies whose combinations k f1 + l f2 are the lines of a torus.

    The first is the drive's; without a drive, that of the strongest line. The second is that of the strongest line
    that is no multiple of the first. It is known up to its sign and multiples of the first. Both maximise the
    transform of the whole series with a Blackman-Harris window. Samples are even, over many periods of both.
    """
    most_first, most_second = 12, 6  # largest multiples of the two frequencies of a torus in its lines
    n = len(values)
    weighted = (values - values.mean()) * signal.get_window("blackmanharris", n)
    power = np.abs(np.fft.rfft(weighted)) ** 2
    power[: LOBE + 1] = 0.0  # the mean's line
    first = drive_hz or _peak(weighted, rate_hz, power)
    rest = np.where(_near(len(power), n / rate_hz * first * np.arange(1, n)), 0.0, power)
    second = _peak(weighted, rate_hz, rest)
    multiples = np.add.outer(
        first * np.arange(-most_first, most_first + 1), second * np.arange(-most_second, most_second + 1)
    )
    inside = _near(len(power), n / rate_hz * np.abs(multiples).ravel())
    return Frequencies(first, second, float(power[inside].sum() / power.sum()))


def _near(n_bins: int, lines: Array) -> Array:
    """Return which bins belong to lines, whose places are given in bins."""
    mask = np.zeros(n_bins, bool)
    middle = np.round(lines[lines < n_bins - 0.5]).astype(int)
    places = np.add.outer(middle, np.arange(-LOBE, LOBE + 1)).ravel()
    mask[places[(places >= 0) & (places < n_bins)]] = True
    return mask


def _peak(weighted: Array, rate_hz: float, power: Array) -> float:
    """Return the frequency near the largest bin at which the transform is largest [Hz]."""
    turns = np.arange(len(weighted)) / len(weighted)
    ends = (power.argmax() - 1.0, power.argmax() + 1.0)

    def size(place: float) -> float:
        return -float(np.abs(weighted @ np.exp(-2j * np.pi * place * turns)))

    found = optimize.minimize_scalar(size, bounds=ends, method="bounded", options={"xatol": 1e-7})
    return float(found.x) * rate_hz / len(weighted)


def power_unit(unit: str, scaling: str) -> str:
    """Return the unit of a power, per hertz for a density: such as m^2/Hz."""
    plain = "1" if unit in ("", "1") else f"{unit}^2" if unit.isalpha() else f"({unit})^2"
    return f"{plain}/Hz" if scaling == "density" else plain


def spectrum_of(
    ds: xr.Dataset,
    channel: str = "",
    *,
    window: str = "hann",
    nperseg: int | None = None,
    scaling: str = "density",
    drive_hz: float | None = None,
) -> xr.Dataset:
    """Average the periodograms of a recording or a trajectory, as `scipy.signal.welch`.

    Parameters
    ----------
    ds
        Evenly sampled variables over ``time`` [s], perhaps in several pieces, see `magpend.read_recording`. Gaps and
        missing samples divide it into stretches. Short gaps are interpolated: those for which interpolation meets the
        known samples.
    channel
        Variable; by default the first.
    window, scaling
        As in `scipy.signal.welch`.
    nperseg
        Samples of a segment; by default a sixteenth of all samples, and more where these segments hold less than 90 %
        of the variance, up to the longest stretch.
    drive_hz
        Frequency of the drive, for orders [Hz]; by default the attribute ``frequency_hz``, if there is one.

    Returns
    -------
    Dataset
        Over ``spectrum`` (one) and ``bin``: ``power`` in unit^2/Hz or unit^2, with the coordinates ``frequency_hz``
        and, with a drive, ``order``. ``n_averages``, ``resolution_hz``, ``bandwidth_hz`` (the window's equivalent noise
        bandwidth), ``variance``, ``kept``, the share of it in the bins, and ``n_interpolated`` samples. The attribute
        ``notes`` says in words what was interpolated or left out, and warns of segments that are too short.

    Raises
    ------
    ValueError
        If there is no such channel, samples are not even, or no piece is as long as a segment.
    """
    series = _stretches(ds, channel)
    channel, rate = series.channel, series.rate_hz
    whole = filled(series.pieces, series.apart)
    long = whole.pieces
    longest = max(map(len, long))
    if not 4 <= (nperseg or longest) <= longest:
        raise ValueError(
            f"nperseg = {nperseg or longest}: must be at least 4, and at most the longest stretch of {channel} without "
            f"a gap, which has {longest} samples."
        )
    if nperseg:
        found = _averaged(long, rate, nperseg, window=window, scaling=scaling)
    else:
        found = _resolved(long, rate, window=window, scaling=scaling)
    drive_hz = drive_hz or ds.attrs.get("frequency_hz")
    unit = shown_unit(ds[channel].attrs, "1")
    both, frequency = ("spectrum", "bin"), found.frequency_hz[None]
    variables: dict[str, Any] = {"power": (both, found.power[None], {"units": power_unit(unit, scaling)})}
    for name in ("n_averages", "resolution_hz", "bandwidth_hz"):
        variables[name] = ("spectrum", [getattr(found, name)])
    variables["variance"] = ("spectrum", [found.variance], {"units": power_unit(unit, "spectrum")})
    variables["kept"] = ("spectrum", [found.kept(scaling)])
    variables["n_interpolated"] = ("spectrum", [whole.n_samples])
    coords: dict[str, Any] = {"frequency_hz": (both, frequency)}
    if drive_hz:
        coords["order"] = (both, frequency / float(drive_hz))
    attrs = {"title": "spectrum", "channel": channel, "unit": unit, "scaling": scaling, "window": window}
    attrs["notes"] = "\n".join(_notes(whole, found, scaling, rate))
    return described(xr.Dataset(variables, coords, {**told_by(ds.attrs), **attrs}), SPECTRUM_COLUMNS)


def _averaged(pieces: Sequence[Array], rate_hz: float, nperseg: int, **settings: str) -> Averaged:
    """Average the periodograms of the pieces that have a whole segment."""
    return averaged([p for p in pieces if len(p) >= nperseg], rate_hz, nperseg=nperseg, **settings)


def _resolved(
    pieces: Sequence[Array], rate_hz: float, chosen: Settings = Settings(), *, window: str, scaling: str
) -> Averaged:
    """Average periodograms of segments that are long enough for the slowest motion, if a piece is."""
    longest = max(map(len, pieces))
    nperseg = min(longest, max(4, sum(map(len, pieces)) // chosen.segments))
    while True:
        found = _averaged(pieces, rate_hz, nperseg, window=window, scaling=scaling)
        # a share that is no number, of a constant series, is not below the bound either
        if nperseg == longest or not found.kept(scaling) < chosen.kept:
            return found
        nperseg = min(2 * nperseg, longest)


def _notes(whole: Filled, found: Averaged, scaling: str, rate_hz: float) -> list[str]:
    """Return sentences about filled gaps, pieces that are left out, and segments that are too short."""
    notes = []
    if whole.n_gaps:
        notes.append(
            f"{whole.n_samples} samples in {whole.n_gaps} short {'gap' if whole.n_gaps == 1 else 'gaps'} were "
            f"interpolated (at most {whole.longest} in a row)"
        )
    lengths = [len(piece) for piece in whole.pieces]
    nperseg = round(rate_hz / found.resolution_hz)
    if short := sum(n for n in lengths if n < nperseg):
        n = sum(n < nperseg for n in lengths)
        notes.append(
            f"{short} of {sum(lengths)} samples were left out: {n} of {len(lengths)} stretches without a gap hold "
            f"fewer than the {nperseg} samples of a segment"
        )
    if (kept := found.kept(scaling)) < Settings.kept:
        is_longest = nperseg == max(lengths)
        remedy = "more samples in a row" if is_longest else f"longer segments, up to {max(lengths)} samples (nperseg)"
        notes.append(
            f"warning: the bins hold {kept:.0%} of the variance; the rest moves more slowly than once in a segment "
            f"({1.0 / found.resolution_hz:.4g} s) and needs {remedy}"
        )
    return notes


class _Stretches(NamedTuple):
    """Stretches of a channel without gaps, in the order of time."""

    channel: str
    pieces: list[Array]
    rate_hz: float
    apart: Array  # from the last sample of a stretch to the first of the next [samples]


def pieces_of(ds: xr.Dataset, channel: str) -> tuple[str, list[Array], float]:
    """Return the channel (by default the first), its stretches without gaps, and its samples per second."""
    found = _stretches(ds, channel)
    return found.channel, found.pieces, found.rate_hz


def _stretches(ds: xr.Dataset, channel: str) -> _Stretches:
    """Divide a channel (by default the first) at its gaps; raise ValueError unless samples are even."""
    # largest deviation of a sampling interval from their median, as a share of it, at which a series counts as even
    uneven = 0.01
    names = [str(name) for name, v in ds.data_vars.items() if v.ndim == 1 and v.dims == ds["time"].dims]
    channel = channel or names[0]
    if channel not in names:
        raise ValueError(f"channel {channel!r} is not there; it has {', '.join(names)}.")
    time, values = (np.asarray(ds[name].values, np.float64) for name in ("time", channel))
    piece = ds["piece"].values if "piece" in ds else np.zeros(len(time), int)
    good = np.isfinite(values)
    cuts = np.flatnonzero((np.diff(piece) != 0) | (np.diff(good.astype(int)) != 0)) + 1
    stretches = [part for part in np.split(np.arange(len(time)), cuts) if len(part) > 1 and good[part[0]]]
    if not stretches:
        raise ValueError(f"channel {channel!r} has no two samples in a row.")
    steps = np.concatenate([np.diff(time[part]) for part in stretches])
    step = float(np.median(steps))
    if (np.abs(steps - step) > uneven * step).any():
        raise ValueError(
            f"the samples of {channel} are {steps.min():.6g} to {steps.max():.6g} s apart, and a spectrum needs even "
            "ones: interpolate the series first."
        )
    # the mean interval of the longest stretch is more exact than the median of rounded times
    longest = max(stretches, key=len)
    rate = (len(longest) - 1) / float(time[longest[-1]] - time[longest[0]])
    apart = np.array([time[after[0]] - time[before[-1]] for before, after in pairwise(stretches)]) * rate
    return _Stretches(channel, [values[part] for part in stretches], rate, apart)
