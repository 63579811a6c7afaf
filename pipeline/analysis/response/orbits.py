"""Measure periodic orbits over their period: half of peak to peak, mean, rms and harmonics of states and quantities."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from magpend_core.models.model import Parameters
from magpend_core.models.sectioned import of_flow
from magpend_core.pointwise import drive_level, evaluate
from magpend_core.precision import tolerances_at
from magpend_core.sampling import Drive, sample
from pipeline.products.reporting import report
from pipeline.results.tolerances import BRANCH_RTOL

FEWEST_TIMES, MOST_TIMES = 512, 8192
"""Samples per drive period or return: at first, and at most."""


MOST_SAMPLED = 2_000_000
"""Samples of all orbits that are integrated in one call, which bounds the memory."""


Array = np.ndarray


class Orbit(NamedTuple):
    """A periodic orbit: its parameters, its section point, its period [s] and in drive periods or returns (0: an
    equilibrium).
    """

    parameters: Parameters
    state: Array
    seconds: float
    period: int

    @property
    def is_driven(self) -> bool:
        """Whether harmonics are those of a drive."""
        return self.parameters.model.clock.has_drive

    @property
    def frequency_hz(self) -> float:
        """Frequency of the drive, or of returns [Hz]."""
        return max(self.period, 1) / self.seconds


@dataclass(frozen=True)
class Measures:
    """Measures of orbits, each of shape (orbit, channel), harmonics (orbit, channel, harmonic).

    Channels are the model's states, then its quantities. A harmonic is the complex amplitude c of
    Re(c exp(i n w t)), with t from the section on. `dominant` is the order of the largest component, in units of the
    drive's frequency, or of the orbit's. The error is the largest change from half of the samples to all of them.
    """

    amplitude: Array
    mean: Array
    rms: Array
    harmonics: Array
    dominant: Array
    error: Array


def measures_of(orbits: Sequence[Orbit], n_harmonics: int, *, of_orbit: bool = False) -> Measures:
    """Integrate orbits over one period each, and measure them. Samples are doubled until the measures settle.

    Orbits are of one model. Harmonics are those of the orbit's own period if `of_orbit`, with a drive as well. NaN for
    orbits that could not be integrated.
    """
    settled = 1e-9  # relative change of all measures, from half of the samples to all of them, at which these suffice
    model = of_flow(orbits[0].parameters).model if orbits else None
    n_channels = 0 if model is None else len(model.states) + len(model.quantities)
    shape = (len(orbits), n_channels)
    amplitude, mean, rms, dominant, error = np.full((5, *shape), np.nan)
    harmonics = np.full((*shape, n_harmonics), np.nan, np.complex128)
    found = Measures(amplitude, mean, rms, harmonics, dominant, error)
    left, n = np.arange(len(orbits)), FEWEST_TIMES
    while len(left) and n <= MOST_TIMES:
        for rows in _blocks(orbits, left, n):
            values = sampled([orbits[i] for i in rows], n)
            base = max(orbits[rows[0]].period, 1) if orbits[rows[0]].is_driven and not of_orbit else 1
            _measure(found, rows, values, base, n_harmonics)
        scale = np.abs(found.mean[left]) + found.amplitude[left]
        left, n = left[(found.error[left] > settled * scale).any(axis=1)], 2 * n
        report("measuring orbits", len(orbits) - len(left), len(orbits))
    return found


def _blocks(orbits: Sequence[Orbit], rows: Array, n: int) -> Iterator[Array]:
    """Yield rows of orbits of equal period, some at a time."""
    periods = np.array([orbits[i].period for i in rows])
    for period in np.unique(periods):
        own = rows[periods == period]
        step = max(1, MOST_SAMPLED // (n * max(period, 1)))
        yield from (own[k : k + step] for k in range(0, len(own), step))


def sampled(orbits: Sequence[Orbit], n: int) -> Array:
    """Return states and quantities at even instants of a period, (orbit, sample, channel), without an angle's turns."""
    times, states = flown(orbits, n)
    flows = [of_flow(orbit.parameters) for orbit in orbits]
    names = [q.name for q in flows[0].model.quantities]
    quantities = [
        evaluate(names, time, own, flow, orbit.frequency_hz)
        if np.isfinite(own).all()
        else np.full((len(time), len(names)), np.nan)
        for orbit, flow, time, own in zip(orbits, flows, times, states, strict=True)
    ]
    is_angle = np.asarray(flows[0].model.system.is_angle, bool)
    turns = np.where(is_angle, np.round((states[:, -1] - states[:, 0]) / (2.0 * np.pi)), 0.0)
    share = np.arange(states.shape[1]) / (states.shape[1] - 1)
    states = states - 2.0 * np.pi * turns[:, None] * share[:, None]
    return np.concatenate([states, np.array(quantities)], axis=-1)[:, :-1]


def flown(orbits: Sequence[Orbit], n: int) -> tuple[list[Array], Array]:
    """Integrate orbits of equal period over this period; return the instants of each and the states there, both ends
    included, (orbit, sample, state).
    """
    period = max(orbits[0].period, 1)
    flows = [of_flow(orbit.parameters) for orbit in orbits]
    share = np.arange(n * period + 1) / (n * period)
    times = [share * orbit.seconds for orbit in orbits]
    starts = np.array([orbit.state for orbit in orbits])
    if not orbits[0].period:
        return times, np.repeat(starts[:, None], len(share), axis=1)
    states = sample(
        flows[0].model.system,
        np.array([flow.pack() for flow in flows]),
        starts,
        times,
        drives=[Drive(np.full(period, orbit.seconds / period)) for orbit in orbits],
        **tolerances_at(BRANCH_RTOL),
        limits_first_step=False,
    ).states
    return times, states


def _measure(found: Measures, rows: Array, values: Array, base: int, n_harmonics: int) -> None:
    """Measure sampled values; the error compares with every second sample."""
    amplitude, harmonics = _amplitude(values), harmonics_of(values, base, n_harmonics)
    found.amplitude[rows], found.harmonics[rows] = amplitude, harmonics
    found.mean[rows] = values.mean(axis=1)
    found.rms[rows] = np.sqrt((values**2).mean(axis=1))
    coarse = values[:, ::2]
    change = np.abs(harmonics - harmonics_of(coarse, base, n_harmonics)).max(axis=-1)
    found.error[rows] = np.maximum(np.abs(amplitude - _amplitude(coarse)), change)
    parts = np.abs(np.fft.rfft(values, axis=1)[:, 1:])
    found.dominant[rows] = np.where(parts.max(axis=1) > 0.0, (1 + parts.argmax(axis=1)) / base, 0.0)


def _amplitude(values: Array) -> Array:
    """Return half of peak to peak, each extreme being that of a parabola through three samples."""
    return np.asarray(0.5 * (highest(values) + highest(-values)))


def highest(values: Array) -> Array:
    """Return the maximum along the samples (axis 1) of periodic values, of a parabola through three samples."""
    at = values.argmax(axis=1)[:, None]
    n = values.shape[1]
    before, here, after = (np.take_along_axis(values, (at + k) % n, axis=1)[:, 0] for k in (-1, 0, 1))
    bend = before - 2.0 * here + after
    slope = 0.5 * (after - before)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(here - np.where(bend < 0.0, 0.5 * slope**2 / bend, 0.0))


def harmonics_of(values: Array, base: int, n_harmonics: int) -> Array:
    """Return the complex amplitudes of the multiples of `base`, (orbit, channel, harmonic)."""
    parts = 2.0 * np.fft.rfft(values, axis=1) / values.shape[1]
    order = base * np.arange(1, n_harmonics + 1)
    return np.moveaxis(parts[:, order], 1, -1)


def lags_of(orbits: Sequence[Orbit], harmonics: Array) -> Array:
    """Return the phases by which harmonics lag behind the drive's first harmonic [rad], from -pi to pi.

    A harmonic is cos(n (w t + a) - lag), where the drive's first harmonic is cos(w t + a). A model whose time
    dependence is no single forcing has a = 0. NaN where a harmonic vanishes.
    """
    nothing = 1e-10  # amplitude of a harmonic, as a share of the largest value, below which it has no phase
    order = np.arange(1, harmonics.shape[-1] + 1)
    shift = np.array([_drive_phase(orbit) for orbit in orbits])[:, None, None]
    lag = np.angle(np.exp(1j * (order * shift - np.angle(harmonics))))
    size = np.abs(harmonics)
    return np.where(size > nothing * np.fmax(size.max(axis=-1, keepdims=True, initial=0.0), nothing), lag, np.nan)


def _drive_phase(orbit: Orbit) -> float:
    flow = of_flow(orbit.parameters)
    if not orbit.is_driven or flow.model.system.forcing_is_time:
        return 0.0
    level = drive_level(np.arange(MOST_TIMES) / (MOST_TIMES * orbit.frequency_hz), flow, orbit.frequency_hz)
    first = np.fft.rfft(level)[1]
    return float(np.angle(first)) if abs(first) > 1e-9 * np.abs(level).sum() else 0.0
