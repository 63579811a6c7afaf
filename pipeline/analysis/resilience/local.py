"""Measure the stability of an attractor against infinitesimal disturbances, in the states' scales.

The fundamental matrix, divided by the scales, tells what becomes of a small disturbance. Its largest singular value is
the largest factor by which one can grow. `reactivity` is the largest rate of growth at once and `amplification` the
largest factor at any later time (Neubert and Caswell, Ecology 78, 653, 1997, eqs. 6 and 9, there of equilibria; of
maps Caswell and Neubert, J. Difference Equ. Appl. 11, 295, 2005). `return_time` is the time in which a small
disturbance shrinks by e at last.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import accumulate
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy.linalg import expm
from scipy.optimize import minimize_scalar

from magpend_core.engine.variational import with_tangents
from magpend_core.equilibria import is_held
from magpend_core.models.model import Parameters
from magpend_core.models.sectioned import of_flow
from magpend_core.pointwise import jacobian
from magpend_core.precision import tolerances_at
from magpend_core.sampling import Drive, sample
from magpend_core.status import Status
from pipeline.analysis.resilience.shocks import Bases, bases_of
from pipeline.layout.vocabulary import EQUILIBRIUM, PERIODIC_ORBIT
from pipeline.results.tolerances import PORTRAIT_RTOL


class Local(NamedTuple):
    """Stability of an attractor against small disturbances; NaN where it is not known."""

    reactivity: float = np.nan  # largest rate of growth at once, at any phase [1/s], of a map [1/iteration]
    amplification: float = np.nan  # largest factor of growth, at least 1
    amplification_time: float = np.nan  # time after the disturbance at which it occurs [s or iterations]
    return_time: float = np.nan  # time in which the slowest disturbance shrinks by e at last [s or iterations]


def local_stability(one: xr.Dataset, parameters: Parameters, frequency: float, scales: np.ndarray) -> Local:
    """Measure reactivity, amplification and return time of an attractor.

    It is given by the variables of `match` without parameter dims and `attractor`, with the parameters and the drive
    frequency [Hz] of its point, and the sizes of the states that count as 1. All is NaN for a set that is no
    equilibrium and no periodic orbit. Of an orbit the maxima are over 64 phases of a period, fewer of a long
    orbit, so they are lower bounds.
    """
    # phases of a drive period, or of a flow's orbit, at which an orbit is sampled, most of a whole orbit, and most of
    # these times the number of states: the matrices between all pairs of phases are then within 128 MiB
    usual, most_phases, most_rows = 64, 512, 4096
    kind, model = int(one["kind"]), parameters.model
    if kind == EQUILIBRIUM:
        state, flow = bases_of(one, parameters, frequency, 1).states, of_flow(parameters)
        if is_held(flow.model.system, state[0], flow.pack()):  # its surface, not the rates' Jacobian, rules there
            slowest = float(one["eigenvalue_real"].values[0])
            return Local(return_time=-1.0 / slowest if slowest < 0.0 else np.inf)
        matrix = _scaled(jacobian(0.0, state, flow, frequency), scales)[0]
        slowest = float(np.linalg.eigvals(matrix).real.max())
        return Local(_growth(matrix), *amplification_at_rest(matrix), -1.0 / slowest if slowest < 0.0 else np.inf)
    n_points = int(one["orbit_period"])
    most = min(most_phases, most_rows // len(scales))
    if kind != PERIODIC_ORBIT or n_points > most:
        return Local()
    is_cycle = model.clock.has_equilibria
    own = of_flow(parameters) if is_cycle else parameters
    period = float(one["period_s"]) if is_cycle else 1.0 / frequency
    bases = bases_of(one, parameters, frequency, usual if is_cycle else min(usual, most // n_points))
    steps = _steps(own, bases, period, scales)
    if steps is None:
        return Local()
    n_phases = len(np.unique(bases.phase))
    grown, late = amplification_of_orbit(steps)
    if not model.clock.is_continuous:
        with np.errstate(divide="ignore"):  # of a superstable point it is -inf
            reactivity = float(np.log(np.linalg.norm(steps, 2, axis=(1, 2)).max()))
    else:
        slopes = [jacobian(p * period, x, own, 1.0 / period) for p, x in zip(bases.phase, bases.states, strict=True)]
        reactivity = _growth(_scaled(np.array(slopes), scales))
    back = _return_time(one, model.clock.n_neutral) * period * (1 if is_cycle else n_points)
    return Local(reactivity, grown, late * period / n_phases, back)


def amplification_at_rest(matrix: np.ndarray) -> tuple[float, float]:
    """Return the largest norm of exp(matrix t) over t >= 0, and its time; NaN if it has not fallen to 1 at last."""
    # times at which the amplification is computed in each of a doubling series of intervals, most intervals, and
    # amplification beyond which it is not sought
    n_times, most_doublings, largest = 64, 60, 1e12

    def size(t: float) -> float:
        return float(np.linalg.norm(expm(t * matrix), 2))

    # exp(A (t + T)) = exp(A t) exp(A T): once the norm is 1 or less at T, no later one is larger than all before
    last = 1e-3 / max(float(np.linalg.norm(matrix, 2)), 1e-300)
    share, best, at, spacing = expm(last / n_times * matrix), 1.0, 0.0, 0.0
    for _ in range(most_doublings):
        powers = np.array(list(accumulate([share] * n_times, np.matmul)))
        sizes = np.linalg.norm(powers, 2, axis=(1, 2))
        if sizes.max() > best:
            best, at, spacing = float(sizes.max()), (1 + int(np.argmax(sizes))) * last / n_times, last / n_times
        if sizes[-1] <= 1.0 or not sizes[-1] < largest:
            break
        last, share = 2.0 * last, share @ share
    if not sizes[-1] <= 1.0:
        return np.nan, np.nan
    if at == 0.0:
        return 1.0, 0.0
    ends = (at - spacing, at + spacing)
    found = minimize_scalar(lambda t: -size(t), bounds=ends, method="bounded", options={"xatol": 1e-9 * ends[1]})
    return max((-float(found.fun), float(found.x)), (size(at), at))


def amplification_of_orbit(steps: np.ndarray) -> tuple[float, int]:
    """Return the largest norm of products of consecutive steps round an orbit, and the number of steps in the product.

    Steps are scaled derivatives from each phase to the next, shape (phase, state, state); the last leads to the first.
    (1, 0) if no product is larger than 1; NaN if the products have not fallen to 1, or come to a limit, in
    many periods.
    """
    # most periods of an orbit until no disturbance is larger than it was, and the relative change of the fundamental
    # matrix over a period below which it has come to its limit
    most_periods, converged = 4096, 1e-6
    n, dim = steps.shape[:2]
    within = np.empty((n, n, dim, dim))  # after r + 1 steps from phase k
    product = np.broadcast_to(np.eye(dim), (n, dim, dim))
    for r in range(n):
        product = within[r] = np.roll(steps, -r, axis=0) @ product
    first = np.linalg.norm(within, 2, axis=(2, 3))
    best, at = 1.0, 0
    if first.max() > 1.0:
        best, at = float(first.max()), 1 + int(np.argmax(first.max(axis=1)))
    whole, power = within[-1], within[-1]
    for m in range(1, most_periods):
        size = np.linalg.norm(power, 2, axis=(1, 2))
        if size.max() <= 1.0:
            return best, at
        rows = np.flatnonzero(first.max(axis=0) * size > best)
        later = np.linalg.norm(within[:, rows] @ power[rows], 2, axis=(2, 3))
        if later.max(initial=0.0) > best * (1.0 + converged):
            best, at = float(later.max()), m * n + 1 + int(np.argmax(later.max(axis=1)))
        power, before = whole @ power, power
        if np.abs(power - before).max() <= converged * np.abs(power).max():
            return best, at
    return np.nan, 0


def _steps(own: Parameters, bases: Bases, period: float, scales: np.ndarray) -> np.ndarray | None:
    """Return the scaled derivatives from each phase of an orbit to the next; None if one is not known."""
    phases, piece = np.unique(bases.phase, return_inverse=True)
    n, system = bases.states.shape[1], own.model.system
    sizes = np.asarray(system.sizes)
    tangents = np.broadcast_to(np.diag(sizes).ravel(), (len(piece), n * n))
    found = sample(
        replace(with_tangents(system, n), n_controlled=None),
        np.tile(own.pack(), (len(piece), 1)),
        np.concatenate([bases.states, tangents], axis=1),
        [np.array([period / len(phases)])] * len(phases),
        piece=piece,
        drives=[Drive(np.array([period]), start_s=float(p) * period) for p in phases],
        **tolerances_at(PORTRAIT_RTOL),
    )
    if (found.status != Status.BOUNDED).any():
        return None
    # tangent vector k, the derivative by state k, is a column
    return _scaled(found.states[:, 0, n:].reshape(-1, n, n).transpose(0, 2, 1) / sizes, scales)


def _scaled(matrices: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Return matrices (..., state, state) for states in units of their scales."""
    return np.asarray(matrices * scales / scales[:, None])


def _growth(matrices: np.ndarray) -> float:
    """Return the largest eigenvalue of the symmetric parts of matrices (..., state, state)."""
    return float(np.linalg.eigvalsh(0.5 * (matrices + np.swapaxes(matrices, -1, -2))).max())


def _return_time(one: xr.Dataset, n_neutral: int) -> float:
    """Return 1/|ln |mu|| of the leading multiplier mu of an orbit, in its periods."""
    multipliers = one["multiplier_real"].values + 1j * one["multiplier_imag"].values
    multipliers = multipliers[np.isfinite(multipliers)]
    if n_neutral and len(multipliers):
        multipliers = np.delete(multipliers, np.argmin(np.abs(multipliers - 1.0)))
    modulus = np.abs(multipliers).max(initial=0.0)
    if not len(multipliers) or modulus >= 1.0:
        return np.nan
    return float(-1.0 / np.log(modulus)) if modulus > 0.0 else 0.0
