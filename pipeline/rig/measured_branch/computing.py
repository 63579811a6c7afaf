"""Compute branches of orbits along a parameter without a run, from attracting orbits and from equilibria."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from magpend_core.models.model import Parameters
from magpend_core.sections import run_branches
from magpend_core.status import Status
from pipeline.analysis.branches import Scope, Start, dataset_of, explore
from pipeline.analysis.branches.carrying import Along

SETTLING = 2000
"""Most drive periods or returns for which a trajectory settles."""

TOLERANCE = 1e-8
"""Tolerance of the integration while trajectories settle; continuation then finds the orbits exactly."""


def branches_along(along: Along, parameters: Parameters, values: Sequence[float], states: np.ndarray) -> xr.Dataset:
    """Compute all branches connected to the orbits that trajectories converge to and, without a drive, to equilibria.

    Parameters
    ----------
    along
        Parameter and interval.
    parameters
        Parameters of the model.
    values
        Values of the parameter at which trajectories settle, shape (n,).
    states
        Their initial states, shape (n, n_states).

    Returns
    -------
    Dataset
        As of the analysis ``branches``.
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
    rows, frequency = along.rows(packed, values)
    found = run_branches(
        rows[:, None],
        frequency[:, None],
        states,
        n_transient=SETTLING,
        n_keep=1,
        rtol=TOLERANCE,
        atol=TOLERANCE,
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
