"""Measure critical eigenvectors round their orbits: a norm that does not depend on where the section lies.

The eigenvector q at a section point becomes v(t) along the orbit, by the flow's derivative. The norm of v is the root
of its mean square over the orbit's period, as in MatCont (Dhooge, Govaerts and Kuznetsov, ACM Trans. Math. Softw. 29,
2003, 141), of a map over the orbit's points. Of a flow without a drive v is known up to a multiple of the rates; the
mean is that of its part across them. All in units of the states, not of their motion in a run.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magpend_core.engine.crossing import without_section
from magpend_core.engine.system import System
from magpend_core.pointwise import rates_at
from magpend_core.precision import tolerances_at
from magpend_core.sampling import Drive, sample
from pipeline.analysis.branches.problems import Rows
from pipeline.results.tolerances import BRANCH_RTOL


@dataclass(frozen=True)
class Settings:
    """Numbers of the means over periods.

    Attributes
    ----------
    instants
        Instants per drive period, or per period of a flow's orbit: the mean of a smooth motion is exact, that of one
        with impacts errs by one over their number.
    """

    instants: int = 256


@dataclass(frozen=True, eq=False)
class Critical:
    """An orbit at a bifurcation, and orbits displaced along the parts of its critical eigenvector.

    Attributes
    ----------
    system
        What is integrated.
    rows
        The orbit's section point, then for each part (real, or real and imaginary) the points ahead and those behind.
    steps
        Sizes of the displacements, each half of the one before.
    seconds
        Period of the orbit [s].
    """

    system: System
    rows: Rows
    steps: np.ndarray
    seconds: float


def mean_squares(one: Critical, settings: Settings = Settings()) -> tuple[np.ndarray, np.ndarray]:
    """Compute the mean square of a critical vector round its orbit by differences of trajectories.

    Returns
    -------
    means, errors : ndarray
        For each size of the displacements but the largest; the error is that of the mean over the instants. NaN where
        trajectories fail.
    """
    system, orbits = _motion(one, settings.instants)
    units = np.asarray(system.units)
    orbit, beside = orbits[0], orbits[1:] / units
    ahead, behind = np.swapaxes(beside.reshape(-1, 2, len(one.steps), *beside.shape[1:]), 0, 1)
    odd, h = ahead - behind, one.steps[1:, None, None]
    vectors = (8.0 * odd[:, 1:] - odd[:, :-1]) / (12.0 * h)  # (part, step, instant, state)
    if one.system.section is not None and np.isfinite(orbit).all():
        flow = rates_at(system, orbit, one.rows.parameters[0][: len(system.parameter_names)]) / units
        flow /= np.linalg.norm(flow, axis=1, keepdims=True)
        vectors = vectors - (vectors * flow).sum(axis=-1, keepdims=True) * flow
    squares = (vectors**2).sum(axis=(0, 3))
    means = squares.mean(axis=1)
    halves = squares[:, ::2].mean(axis=1) if not system.is_map else means
    return means, np.abs(means - halves)


def _motion(one: Critical, instants: int) -> tuple[System, np.ndarray]:
    """Return the system without its section, and states (trajectory, instant, state) over a period, angles with
    turns.
    """
    system, rows, period = without_section(one.system), one.rows, one.rows.period
    if system.is_map:
        times, drive = np.arange(float(period)), None
    elif one.system.section is None:
        n = instants * period
        times = one.seconds * np.arange(n) / n
        drive = Drive(np.full(period, one.seconds / period))
    else:
        times, drive = one.seconds * np.arange(instants) / instants, Drive(np.array([one.seconds]))
    found = sample(
        system,
        rows.parameters[:, : len(system.parameter_names)],
        rows.states,
        [times],
        piece=np.zeros(len(rows.states), np.int64),
        drives=[drive],
        limits_first_step=False,
        **tolerances_at(BRANCH_RTOL),
    )
    return system, found.states
