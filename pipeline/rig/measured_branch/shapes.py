"""Compute amplitude, mean, frequency and harmonics of computed orbits, for comparison with measured ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magpend_core.models.model import Model
from magpend_core.models.sectioned import SectionedModel
from magpend_core.sampling import Drive, sample
from pipeline.rig.measured_branch.cycles import N_HARMONICS

SAMPLES = 256
"""Samples of a computed orbit in each drive period or return."""

RTOL = 1e-10
"""Tolerance of the integration: slopes are differences of these numbers."""


@dataclass(frozen=True)
class Shapes:
    """Amplitude, mean, frequency and harmonics of one state, one entry per orbit; NaN where the integration failed."""

    amplitude: np.ndarray  # (n,) half of the peak-to-peak value [the state's unit]
    mean: np.ndarray  # (n,) mean over the orbit
    frequency: np.ndarray  # (n,) drive periods or returns per second [Hz]
    harmonics: np.ndarray  # (n, N_HARMONICS) amplitudes of the Fourier components at multiples of the frequency

    def columns(self) -> dict[str, np.ndarray]:
        """Return amplitude, mean, frequency and harmonics by name, as in the columns of a measured branch."""
        named = {"amplitude": self.amplitude, "mean": self.mean, "frequency": self.frequency}
        return named | {f"harmonic_{k + 1}": self.harmonics[:, k] for k in range(N_HARMONICS)}


def shapes_of(
    model: Model, packed: np.ndarray, states: np.ndarray, seconds: np.ndarray, period: int, state: str
) -> Shapes:
    """Integrate periodic orbits over one period, and return the shape (amplitude, mean, ...) of one state.

    Parameters
    ----------
    model
        Forced model, or a flow with its Poincare section.
    packed
        Packed parameters of each orbit, shape (n, n_parameters) [SI].
    states
        A section point of each orbit, shape (n, n_states) [SI].
    seconds
        Duration of each orbit, shape (n,) [s].
    period
        Drive periods or returns of each orbit.
    state
        Name of the state.
    """
    flow = model.flow if isinstance(model, SectionedModel) else model
    grid = np.arange(SAMPLES * period + 1) / (SAMPLES * period)
    known = np.isfinite(states).all(axis=1) & np.isfinite(seconds)
    if not known.any():
        none = np.full(len(states), np.nan)
        return Shapes(none, none, none, np.full((len(states), N_HARMONICS), np.nan))
    samples = sample(
        flow.system,
        packed[known][:, : len(flow.parameter_names)],
        states[known],
        [s * grid for s in seconds[known]],
        drives=None if flow is not model else [Drive(np.full(period, s / period)) for s in seconds[known]],
        columns=[flow.state_names.index(state)],
        rtol=RTOL,
        atol=RTOL,
        limits_first_step=False,
    )
    values = np.full((len(states), SAMPLES * period), np.nan)
    values[known] = samples.states[:, :-1, 0]
    lines = np.fft.rfft(values, axis=1) / values.shape[1]
    return Shapes(
        0.5 * (_peak(values) + _peak(-values)),
        np.asarray(lines[:, 0].real),
        period / seconds,
        np.asarray(2.0 * np.abs(lines[:, period : period * N_HARMONICS + 1 : period])),
    )


def _peak(values: np.ndarray) -> np.ndarray:
    """Return the maximum of sampled periodic signals (n, m), refined by a parabola through three samples."""
    rows = np.arange(len(values))
    top = np.argmax(np.nan_to_num(values, nan=-np.inf), axis=1)
    here = values[rows, top]
    before, after = values[rows, top - 1], values[rows, (top + 1) % values.shape[1]]
    bend = before - 2.0 * here + after
    slope = 0.5 * (after - before)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(bend < 0.0, here - 0.5 * slope**2 / bend, here))
