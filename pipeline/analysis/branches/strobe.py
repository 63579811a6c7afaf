"""Find the section point of an orbit on the other side of an impact that coincides with the strobe.

Along a branch the instant of an impact moves through the instant of the sections. The orbits and their multipliers
change smoothly there, but the section point jumps from the state before the impact to the state after it. A
continuation goes on from the section point on the other side: the orbit's states shortly before or after the section,
extrapolated to it without the impact.
"""

from __future__ import annotations

import numpy as np

from magpend_core.engine.system import System
from magpend_core.orbits import scaled_distance, wrap_angles
from magpend_core.sampling import Drive, sample
from magpend_core.status import Status
from pipeline.results.tolerances import BRANCH_RTOL

EXTRAPOLATES = np.array([4.0, -6.0, 4.0, -1.0])
"""Weights of the states at 1, 2, 3 and 4 distances in the cubic through them at distance 0."""


def other_side(
    system: System, state: np.ndarray, packed: np.ndarray, frequency_hz: float, period: int
) -> np.ndarray | None:
    """Return the section point of an orbit on the other side of an impact at the strobe; None if there is no such
    impact.

    Parameters
    ----------
    system
        What is integrated.
    state
        Section point of the orbit, shape (n_states,).
    packed
        Parameters, shape (n_parameters,).
    frequency_hz
        Drive frequency [Hz].
    period
        Period of the orbit [drive periods].
    """
    # distances in time of the states from the section, in drive periods, tried in turn: the impact lies nearer to it
    shares = (1e-5, 1e-4, 1e-3, 1e-2)
    # least scaled jump that is an impact, and the largest error of the extrapolated state in units of the jump
    least_jump, unsure = 1e-4, 0.1
    if not system.n_impacts or system.section is not None:
        return None
    drive = Drive(np.full(period, 1.0 / frequency_hz))
    for share in shares:
        after = share / frequency_hz * np.arange(1.0, 5.0)
        times = np.concatenate([after, period / frequency_hz - after[::-1]])
        orbit = sample(system, packed[None], state[None], [times], drives=[drive], rtol=BRANCH_RTOL, atol=BRANCH_RTOL)
        if orbit.status[0] != Status.BOUNDED:
            return None
        for near in (orbit.states[0][:4], orbit.states[0][:3:-1]):
            found = EXTRAPOLATES @ near
            jump = scaled_distance(found, state, system)
            if jump > least_jump and scaled_distance(found, 2.0 * near[0] - near[1], system) < unsure * jump:
                return wrap_angles(found, system)
    return None
