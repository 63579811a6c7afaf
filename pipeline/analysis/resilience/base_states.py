"""Sample the states on an attractor at phases of the drive, and bring shocked states to the next section."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr

from magpend_core.models.model import Parameters
from magpend_core.models.sectioned import of_flow
from magpend_core.sampling import Drive, sample
from magpend_core.status import Status
from pipeline.analysis.attractors.destinations import UNDECIDED, Destinations
from pipeline.analysis.outcomes import DIVERGED
from pipeline.analysis.resilience.shocks import Found, Search, Trials
from pipeline.analysis.together import run_together
from pipeline.analysis.tolerances import PORTRAIT_RTOL
from pipeline.layout.vocabulary import EQUILIBRIUM, PERIODIC_ORBIT
from pipeline.products.reporting import report

MOST_POINTS = 8
"""Most section points of a set that does not close from which shocks start."""


@dataclass(frozen=True)
class Bases:
    """States on an attractor from which shocks start.

    Attributes
    ----------
    states : ndarray, (n, state)
        Neighbours in time next to each other.
    phase : ndarray, (n,)
        Time since the section before each state, as a share of the drive period, or of the period of an orbit of
        a flow.
    at_section : ndarray of bool, (n,)
        Whether each state lies on the section, so that its grid of initial states applies.
    """

    states: np.ndarray
    phase: np.ndarray
    at_section: np.ndarray

    @property
    def sections(self) -> Bases:
        """The states that lie on the section."""
        return Bases(self.states[self.at_section], self.phase[self.at_section], self.at_section[self.at_section])


def bases_of(one: xr.Dataset, parameters: Parameters, frequency: float, n_phases: int) -> Bases:
    """Sample the states on an attractor at equally spaced phases.

    Parameters
    ----------
    one
        Attractor: variables of `match` without parameter dims and `attractor`.
    parameters, frequency
        Parameters of the point, and drive frequency [Hz].
    n_phases
        Number of phases in a drive period, or in the period of an orbit of a flow.
    """
    stored = one["attractor_points"].transpose("point", "state").values
    points = stored[np.isfinite(stored).all(axis=-1)]
    kind = int(one["kind"])
    if kind == EQUILIBRIUM:
        return Bases(points[:1], np.zeros(1), np.ones(1, bool))
    if parameters.model.autonomous:
        if kind == PERIODIC_ORBIT:
            period = float(one["period_s"])
            return _sampled(of_flow(parameters), points[:1], period, n_phases)
        points = points[:MOST_POINTS]
        return Bases(points, np.zeros(len(points)), np.ones(len(points), bool))
    n = int(one["orbit_period"]) if kind == PERIODIC_ORBIT else MOST_POINTS
    return _sampled(parameters, points[:n], 1.0 / frequency, n_phases)


def _sampled(parameters: Parameters, points: np.ndarray, period: float, n_phases: int) -> Bases:
    """Integrate from section points, and return the states at equally spaced phases of the next period."""
    phase = np.arange(n_phases) / n_phases
    n = len(points)
    states = points[:, None]
    if n_phases > 1:
        found = sample(
            parameters.model.system,
            np.tile(parameters.pack(), (n, 1)),
            points,
            [phase * period],
            piece=np.zeros(n, np.int64),
            drives=[Drive(np.array([period]))],
            rtol=PORTRAIT_RTOL,
            atol=PORTRAIT_RTOL,
        )
        states = found.states
    at_section = np.tile(phase == 0.0, n)
    return Bases(states.reshape(-1, points.shape[1]), np.tile(phase, n), at_section)


class Shocked:
    """Shocked trajectories at a parameter point: brings them to the next section, and tells where they end."""

    def __init__(self, destinations: Destinations) -> None:
        self._destinations, self._point = destinations, destinations.point

    def labels(self, states: np.ndarray, phase: np.ndarray) -> np.ndarray:
        """Return the label of the attractor on which each trajectory ends; see `Destinations.follow`.

        Parameters
        ----------
        states
            Shocked states, shape (n, state).
        phase
            Share of the drive period at which each shock happens, shape (n,).
        """
        label = np.full(len(states), UNDECIDED, np.int64)
        states, status = self._to_section(states, phase)
        label[status == Status.DIVERGED] = DIVERGED
        good = np.flatnonzero(status == Status.BOUNDED)
        label[good] = self._destinations.follow(states[good]).label
        return label

    def _to_section(self, states: np.ndarray, phase: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Integrate trajectories that start within a drive period to its end; return their states and status."""
        states, status = states.copy(), np.full(len(states), int(Status.BOUNDED), np.int64)
        rows = np.flatnonzero(phase > 0.0) if not self._point.can_rest else np.zeros(0, np.int64)
        if not len(rows):
            return states, status
        phases, piece = np.unique(phase[rows], return_inverse=True)
        period, settings = 1.0 / self._point.frequency, self._destinations.settings
        found = sample(
            self._point.integrates,
            np.tile(self._point.packed, (len(rows), 1)),
            states[rows],
            [np.array([period * (1.0 - p)]) for p in phases],
            piece=piece,
            drives=[Drive(np.array([period]), start_s=float(p) * period) for p in phases],
            rtol=settings.rtol,
            atol=settings.atol,
        )
        states[rows], status[rows] = found.states[:, 0], found.status
        return states, status


@dataclass(frozen=True)
class Asked:
    """A search for shocks, with the base states and the states that are shocked.

    Attributes
    ----------
    search : generator
        See `shocks.ShockSearch.run`.
    bases : Bases
    which : ndarray of int
        Numbers of the shocked states.
    """

    search: Search
    bases: Bases
    which: np.ndarray


def search_together(asked: Mapping[str, Asked], shocked: Shocked, scales: np.ndarray, what: str) -> dict[str, Found]:
    """Run searches for shocks in step, so that their trajectories fill the engine's lanes together.

    Returns
    -------
    dict
        Result of each search.
    """
    n_followed = 0

    def answer(trials: dict[str, Trials], results: Mapping[str, Found]) -> dict[str, np.ndarray]:
        nonlocal n_followed
        report(what, n_followed, 0)
        states, phase = zip(*(_states(trial, asked[key], scales) for key, trial in trials.items()), strict=True)
        found = shocked.labels(np.concatenate(states), np.concatenate(phase))
        n_followed += len(found)
        ends = np.cumsum([len(trial.base) for trial in trials.values()])[:-1]
        return dict(zip(trials, np.split(found, ends), strict=True))

    return run_together({key: one.search for key, one in asked.items()}, answer)


def _states(trials: Trials, asked: Asked, scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the shocked states and their phases."""
    states = asked.bases.states[trials.base].copy()
    states[:, asked.which] += trials.shock * scales[asked.which]
    return states, asked.bases.phase[trials.base]
