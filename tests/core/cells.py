"""Cells, orbits and maps by the engine, and ends of trajectories by scipy, for tests of the core and of analyses."""

import numpy as np
from scipy.integrate import solve_ivp

from magpend_core import run_branches
from magpend_core.models.pendulum.systems import PENDULUM_FITTED
from magpend_core.orbits import polish_orbits, section_map

# quantities that tests watch: an engine is compiled for each choice of them
OF_THE_DRIVE = ("drive_torque", "psi1")
# the last has peaks of the Stribeck effect that are hardly wider than a step
OF_THE_MOTION = ("energy", "power_in", "power_dissipated", "load2", "magnet_moment", "magnet_x", "friction1")
OF_THE_PENDULUM = OF_THE_DRIVE + OF_THE_MOTION


def run_cells(system, parameters, frequency, starts, *, rtol=1e-8, **options):
    """Integrate cells at one parameter point each, at parameters and frequencies of all or of each."""
    starts = np.atleast_2d(np.asarray(starts, float))
    column = (len(starts), 1)
    packed = np.broadcast_to(np.atleast_2d(parameters)[:, None], (*column, len(system.parameter_names)))
    hertz = None if frequency is None else np.broadcast_to(np.reshape(frequency, (-1, 1)), column)
    options = {"n_transient": 0, "n_keep": 1, "rtol": rtol, "atol": rtol, **options}
    return run_branches(packed, hertz, starts, system=system, **options)


def polish(parameters, points, period=1, frequency=None, **options):
    """Polish closed orbits of one model from points near them; those of a flow by its section."""
    n, model = len(points), parameters.model
    hertz = np.full(n, model.crossing.frequency_hz if frequency is None else frequency)
    packed, periods = np.tile(parameters.pack(), (n, 1)), np.broadcast_to(period, n)
    return polish_orbits(packed, hertz, np.asarray(points, float), periods, system=model.system, **options)


def stroboscopic_map(*given, system=PENDULUM_FITTED, **options):
    """Images of section points, and the derivatives of the last images."""
    found = section_map(*given, system=system, **options)
    return found.images, found.derivatives


def scipy_end(rates, start, time, tolerance=1e-12, begin=0.0, **options):
    """State at a time by DOP853."""
    options = {"rtol": tolerance, "atol": tolerance, **options}
    return solve_ivp(rates, (begin, time), start, "DOP853", **options).y[:, -1]
