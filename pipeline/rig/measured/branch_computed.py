"""Compute branches of orbits along a parameter without a run, and the shapes of their orbits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from magpend_core.models.model import Model, Parameters
from magpend_core.models.sectioned import SectionedModel
from magpend_core.sampling import Drive, sample
from magpend_core.sections import run_branches
from magpend_core.status import Status
from pipeline.analysis.branches.carrying import Along
from pipeline.analysis.branches.dataset import dataset_of
from pipeline.analysis.branches.exploring import Scope, explore
from pipeline.analysis.branches.known import Start
from pipeline.layout.vocabulary import FREQUENCY_DIM
from pipeline.rig.measured.branch import N_HARMONICS


def branches_along(along: Along, parameters: Parameters, values: Sequence[float], states: np.ndarray) -> xr.Dataset:
    """Compute all branches connected to the orbits that trajectories converge to and, without a drive, to equilibria.

    Trajectories settle at `values` of the parameter, (n,), from `states`, (n, n_states). Return a dataset as of the
    analysis ``branches``.
    """
    packed = parameters.pack()
    starts = _settled(along, packed, values, states)
    if along.model.crossing is not None:
        rest = np.zeros(len(along.model.states))
        starts += [Start(along.family(0, packed), rest, value) for value in (along.low, along.high)]
    found = explore(starts, Scope(along.low, along.high, along.max_period, 1))
    return dataset_of(found, along.parameter, parameters)


def _settled(along: Along, packed: np.ndarray, values: Sequence[float], states: np.ndarray) -> list[Start]:
    """Integrate trajectories until they close, and return the closed ones as starting orbits."""
    most = 2000  # drive periods or returns for which a trajectory settles
    tolerance = 1e-8  # of the integration while trajectories settle; continuation then finds the orbits exactly
    rows, frequency = along.rows(packed, values)
    found = run_branches(
        rows[:, None],
        frequency[:, None],
        states,
        n_transient=most,
        n_keep=1,
        rtol=tolerance,
        atol=tolerance,
        stop_when_closed=True,
        max_orbit_period=along.max_period,
        system=along.model.system,
    )
    is_closed = found.status[:, 0] == Status.PERIODIC
    return [
        Start(along.family(int(found.orbit_period[i, 0]), rows[i]), found.section[i, 0, -1], float(value))
        for i, value in enumerate(values)
        if is_closed[i]
    ]


# ---- shapes ----------------------------------------------------------------------------------------


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

    Each orbit has a row of packed parameters, a section point `states` [SI], and its duration `seconds`; `period`
    counts the drive periods or returns of all. The model has a drive, or a Poincare section.
    """
    n_samples = 256  # of a computed orbit in each drive period or return
    rtol = 1e-10  # slopes are differences of these numbers
    flow = model.flow if isinstance(model, SectionedModel) else model
    grid = np.arange(n_samples * period + 1) / (n_samples * period)
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
        rtol=rtol,
        atol=rtol,
        limits_first_step=False,
    )
    values = np.full((len(states), n_samples * period), np.nan)
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


def amplitudes(branches: xr.Dataset, base: Parameters, state: str) -> np.ndarray:
    """Return half of the peak-to-peak value of a state on every orbit of computed branches, (branch, point).

    It is 0 for equilibria, NaN beyond a branch's own points; `base` are the parameters of the run.
    """
    parameter = str(branches.attrs["parameter"])
    found = np.full((branches.sizes["branch"], branches.sizes["point"]), np.nan)
    for i in range(branches.sizes["branch"]):
        n, period = int(branches["n_points"][i]), int(branches["orbit_period"][i])
        if not period:
            found[i, :n] = 0.0
            continue
        own = {name: float(branches[name][i]) for name in base.names if name in branches}
        packed = np.tile(base.replace(**own).pack(), (n, 1))
        if parameter != FREQUENCY_DIM:
            packed[:, base.names.index(parameter)] = branches["parameter"].values[i, :n]
        states, seconds = branches["section"].values[i, :n, 0], branches["period_s"].values[i, :n]
        found[i, :n] = shapes_of(base.model, packed, states, seconds, period, state).amplitude
    return found
