"""Compute stroboscopic section points of a recording: states and rates at the rising edges of the drive.

A recording has noisy angles, and its samples are not synchronous with the drive. A polynomial is fitted on
either side of each edge, with the continuous quantities in common. When the torque jumps, an angle and its
rate are continuous, so both sides share value and slope and differ from the curvature on. For a measured rate
both sides share only the value. The fit is as precise as one polynomial across the edge, without the bias of
ignoring it.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from magpend_core.models.model import Model, Parameters, State
from pipeline.layout.vocabulary import model_attribute, model_of
from pipeline.rig.edges import Edges, find_edges
from pipeline.rig.measured.declaration import WINDOW_S
from pipeline.specification.problems import SpecError

Floats = npt.NDArray[np.float64]

_LEAST_SPARE = 3
"""Fewest samples on either side beyond the number of its own coefficients."""


@dataclass(frozen=True)
class Channel:
    """Measured state of a recording. The slope of the state gives its rate if the rate itself is not measured."""

    name: str
    place: int  # index among the model's states
    slope: int  # index of the rate's state; -1 if the slope is no state or is measured
    smooth: bool  # whether the slope is continuous across an edge


def channels_of(recording: xr.Dataset, model: Model) -> list[Channel]:
    """Return the measured states of a recording; the slope of a state gives a rate that is not measured."""
    names = model.state_names

    def channel(place: int, state: State) -> Channel:
        alone = bool(state.rate) and state.rate not in recording
        return Channel(state.name, place, names.index(state.rate) if alone else -1, bool(state.rate))

    found = [channel(i, s) for i, s in enumerate(model.states) if s.name in recording]
    if not found:
        raise SpecError(
            f"{name_of(recording)}: none of the states of {model.name} ({', '.join(names)}) is measured: "
            "name at least one under [channels] of the mapping."
        )
    return found


def name_of(recording: xr.Dataset) -> str:
    """Return the file name of a recording, for messages."""
    return str(recording.attrs.get("file") or "the recording")


def find_sections(recording: xr.Dataset, edges: Edges, *, window_s: float = WINDOW_S, order: int = 3) -> xr.Dataset:
    """Return the states at the rising edges of the drive, from local polynomials with a kink at the edge.

    Long windows `window_s` [s] average noise, short ones follow the motion; they end at neighbouring edges. The dims
    are ``edge`` and ``state`` (the known ones). ``section``: states in the units of the model, angles not wrapped;
    ``section_noise``: their standard deviation from the channels' noise; ``kink``: jump of the state's derivative at
    the edge, NaN if unknown. The coordinate ``time`` is that of the edge [s]. An edge with too few samples on a side
    (at a gap or an end) is left out. The attribute ``noise`` holds the noise of a sample by channel, from the
    residuals, as JSON.

    Raise `SpecError` if no state is measured, the window is too short for the sampling rate, or no edge has a window.
    """
    model = model_of(recording)
    channels = channels_of(recording, model)
    _check(recording, window_s, order)
    known = sorted({c.place for c in channels} | {c.slope for c in channels} - {-1})
    fits = _fits(recording, edges, channels, window_s, order)
    if not fits:
        raise SpecError(
            f"{name_of(recording)}: no rising edge of the drive has samples on either side; choose a longer "
            "stretch of the recording, or a shorter window_s."
        )
    kept, values, spread, variance, jumps = (np.array(part) for part in zip(*fits, strict=True))
    noise = np.sqrt(np.median(variance, axis=0))
    section, blur, kink = (np.full((len(kept), len(model.states)), np.nan) for _ in range(3))
    for i, c in enumerate(channels):
        for place, column in ((c.place, 0), (c.slope, 1)):
            if place >= 0:
                section[:, place] = values[:, i, column]
                blur[:, place] = spread[:, i, column] * noise[i]
        # the kink of an angle's slope belongs to its rate, that of a measured rate to itself
        kink[:, c.slope if c.smooth else c.place] = jumps[:, i] if c.slope >= 0 or not c.smooth else np.nan
    units = [model.states[i].unit for i in known]
    about = {"long_name": "state at the rising edge", "units": "see state_units"}
    return xr.Dataset(
        {
            "section": (("edge", "state"), section[:, known], about),
            "section_noise": (("edge", "state"), blur[:, known], {**about, "long_name": "its noise"}),
            "kink": (("edge", "state"), kink[:, known], {"long_name": "jump of its derivative"}),
        },
        coords={
            "time": ("edge", edges.rising[kept], {"units": "s", "long_name": "instant of the edge"}),
            "number": ("edge", kept),
            "state": [model.state_names[i] for i in known],
            "state_units": ("state", units),
        },
        attrs={
            "model": model_attribute(model),
            "file": name_of(recording),
            "window_s": window_s,
            "order": order,
            "noise": json.dumps({c.name: float(s) for c, s in zip(channels, noise, strict=True)}),
        },
    )


def _check(recording: xr.Dataset, window_s: float, order: int) -> None:
    if order < 2:
        raise SpecError(f"order = {order}: must be at least 2, so that the curvature can differ.")
    step = float(np.median(np.diff(recording["time"].values)))
    least = 2 * (order + _LEAST_SPARE) * step
    if not window_s >= least:
        raise SpecError(
            f"window_s = {window_s:g}: must be at least {least:.3g} at {1 / step:g} samples per second and "
            f"order {order}."
        )


def _fits(
    recording: xr.Dataset, edges: Edges, channels: list[Channel], window_s: float, order: int
) -> list[tuple[int, Floats, Floats, Floats, Floats]]:
    """Fit polynomials about each rising edge with enough samples around it; return number and fit of each."""
    time = recording["time"].values
    piece = recording["piece"].values if "piece" in recording.coords else np.zeros(time.size, np.int64)
    data = np.stack([recording[c.name].values for c in channels], axis=1)
    instants = np.sort(np.concatenate([edges.rising, edges.falling]))
    found = []
    for number, at in enumerate(edges.rising):
        half = min(0.5 * window_s, _nearest(instants, at, 0.25 * window_s))
        first, last = np.searchsorted(time, [at - half, at + half])
        own = piece[first:last]
        if own.size and (own == own[0]).all():
            fit = _fit(time[first:last] - at, data[first:last], channels, half, order)
            if fit is not None:
                found.append((number, *fit))
    return found


def _nearest(instants: Floats, at: float, beyond: float) -> float:
    """Return the time from `at` to the nearest drive edge that is more than `beyond` away. Return infinity if there is
    none.

    An edge placed by a fitted line differs slightly from the detected one.
    """
    low, high = np.searchsorted(instants, [at - beyond, at + beyond])
    before = at - instants[low - 1] if low else math.inf
    after = instants[high] - at if high < instants.size else math.inf
    return float(min(before, after))


def _fit(
    t: Floats, data: Floats, channels: list[Channel], half: float, order: int
) -> tuple[Floats, Floats, Floats, Floats] | None:
    """Fit a polynomial to each channel; return value and slope, errors per unit noise, residual variance, kink."""
    if min((t < 0).sum(), (t >= 0).sum()) < order + _LEAST_SPARE or not np.isfinite(data).all():
        return None
    values, spread = np.empty((len(channels), 2)), np.empty((len(channels), 2))
    variance, jumps = np.empty(len(channels)), np.empty(len(channels))
    for smooth in {c.smooth for c in channels}:
        which = [i for i, c in enumerate(channels) if c.smooth == smooth]
        basis = _basis(t / half, order, smooth)
        inverse = np.linalg.pinv(basis)
        coefficients = inverse @ data[:, which]
        residual = data[:, which] - basis @ coefficients
        scale = np.array([1.0, 1.0 / half])
        values[which] = coefficients[:2].T * scale
        spread[which] = np.sqrt((inverse[:2] ** 2).sum(axis=1)) * scale
        variance[which] = (residual**2).sum(axis=0) / (len(t) - basis.shape[1])
        # the first pair of coefficients that both sides do not share: of curvature, or of slope
        first = basis.shape[1] - 2 * (order - 1) if smooth else 1
        jumps[which] = (coefficients[first + 1] - coefficients[first]) * (2 / half**2 if smooth else 1 / half)
    return values, spread, variance, jumps


def _basis(x: Floats, order: int, smooth: bool) -> Floats:
    """Return the design matrix of a polynomial fit, with separate terms before and after the edge."""
    left, right = np.where(x < 0, x, 0.0), np.where(x < 0, 0.0, x)
    first = 2 if smooth else 1
    shared = [np.ones_like(x), x] if smooth else [np.ones_like(x)]
    own = [side**k for k in range(first, order + 1) for side in (left, right)]
    return np.stack([*shared, *own], axis=1)


# ---- phase of the model's section ------------------------------------------------------------------


def section_phase(parameters: Parameters, frequency_hz: float) -> float:
    """Return the phase of the model's stroboscopic section after the drive's rising edge, a fraction of the period in
    [0, 1).

    It is 0 for sections at the rising edge and without a drive, 0.25 at the maximum of a sine.
    """
    from magpend_core.pointwise import drive_level

    n = 4096
    snap = 2e-3  # fraction of a period below which a phase counts as 0, since a flank is as wide

    period = 1 / frequency_hz
    time = np.arange(2 * n) * period / n
    try:
        rising = find_edges(time, drive_level(time, parameters, frequency_hz)).rising
    except SpecError:
        return 0.0
    share = float(-rising[0] / period % 1.0)
    return 0.0 if min(share, 1.0 - share) < snap else share
