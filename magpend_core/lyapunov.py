"""Estimate Lyapunov exponents of many trajectories from variational equations integrated by the engine.

Method of Benettin, Galgani, Giorgilli and Strelcyn, Meccanica 15 (1980) 9-30: tangent vectors are carried
along by the analytic Jacobian and made orthonormal again (QR by modified Gram-Schmidt) at set times; the
mean logarithmic growth of the k-th of them is the k-th exponent.

The times are every section, every edge of the drive, and whenever volumes have shrunk by exp(12) since the
last one. The latter happens while a joint sticks: the friction's slope at rest then contracts by some
1000 /s, which within a few hundredths of a second would turn all vectors into one direction.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from magpend_core.defaults import ATOL, MOST_STEPS, RTOL
from magpend_core.engine.entry import N_LANES, integrate
from magpend_core.engine.jit import inline
from magpend_core.engine.observers import PENDING, Observer
from magpend_core.engine.system import System
from magpend_core.engine.tangents import WRITTEN_OUT_MAPS
from magpend_core.engine.variational import with_tangents
from magpend_core.engine.vecmath import exp, log
from magpend_core.status import Status
from magpend_core.validation import check_array, check_count, check_frequency, check_states

BOUNDED = int(Status.BOUNDED)

SHRUNK = -12.0
"""Logarithm of the change of volume at which the vectors are made orthonormal."""

SHORTEST = 1e-100
"""Length at which a tangent vector counts as gone, in units of `LENGTH`."""

MOST_LOSS = 1e14
"""Shortening of a vector in one orthonormalisation beyond which rounding errors decide its direction."""


MOST_NUMBERS = 2**24
"""Numbers that the records of cells in one call of the engine may have: a large system's have many."""


@dataclass(frozen=True)
class LyapunovExponents:
    """Lyapunov exponents with errors, block averages and status; the first dimension is the trajectory.

    Attributes
    ----------
    exponents : ndarray, (cell, exponent)
        In falling order [1/s]; NaN for cells that failed.
    stderr : ndarray, (cell, exponent)
        Standard error of the mean over the blocks [1/s].
    weighted : ndarray, (cell, exponent)
        Weighted Birkhoff averages [1/s]: better than `exponents` on closed and quasi-periodic orbits,
        somewhat worse in chaos. In their order.
    blocks : ndarray, (cell, block, exponent)
        Mean growth rate in each block of drive periods [1/s].
    divergence : ndarray, (cell,)
        Time average of the trace of the Jacobian over the same periods [1/s], to which the exponents
        of a full spectrum add up; of a map the mean of log ``|det J|``, NaN for one with more than three states.
    loss : ndarray, (cell,)
        Largest factor by which an orthonormalisation shortened a vector. Beyond `MOST_LOSS` the later
        exponents are not resolved.
    status : ndarray of int8, (cell,)
        ``BOUNDED`` if all went well, or how the trajectory failed.
    is_whole : bool
        Whether there is an exponent for each state. Only then does their sum have to be `divergence`.
    """

    exponents: np.ndarray
    stderr: np.ndarray
    weighted: np.ndarray
    blocks: np.ndarray
    divergence: np.ndarray
    loss: np.ndarray
    status: np.ndarray
    is_whole: bool


LENGTH = 1e-3
"""Length of the tangent vectors after orthonormalisation.

They enter the error control like states: with this length at a thousandth of the trajectory's accuracy,
which costs nothing where the trajectory moves, and keeps the steps within the method's stability where it
rests.
"""


class _Settings(NamedTuple):
    n_transient: int
    n_blocks: int
    periods_per_block: int


# The observer's memory: since the last section, sums of logarithms, integral of the divergence, largest loss,
# and with a section by crossing the time, which the engine puts last. A row of its record: the sums over a
# block, and then its time. Its measures: weighted sums, the sum of weights (times the time), largest loss.


def _orthonormalise(state: Any, memory: Any, settings: Any) -> None:
    """Make the tangent vectors orthonormal in units of the sizes, and add the logarithms of their former lengths to the
    observer's memory.
    """
    n_vectors = N_TANGENTS // N_BASE
    for k in range(n_vectors):
        own = N_BASE * (1 + k)
        before = 0.0
        for i in range(N_BASE):
            before += (state[own + i] / SIZES[i]) * (state[own + i] / SIZES[i])
        for j in range(k):
            other = N_BASE * (1 + j)
            along = 0.0
            for i in range(N_BASE):
                along += (state[own + i] / SIZES[i]) * (state[other + i] / SIZES[i]) / LENGTH**2
            for i in range(N_BASE):
                state[own + i] -= along * state[other + i]
        after = 0.0
        for i in range(N_BASE):
            after += (state[own + i] / SIZES[i]) * (state[own + i] / SIZES[i])
        # a vector can vanish: along the one by which trajectories that begin to slide differed
        length = max(np.sqrt(after) / LENGTH, SHORTEST)
        for i in range(N_BASE):
            state[own + i] /= length
        memory[k] += log(length)
        memory[n_vectors + 1] = max(memory[n_vectors + 1], np.sqrt(before / after)) if after > 0.0 else np.inf
    memory[n_vectors] += state[N - 1]
    state[N - 1] = 0.0


def _average(section: Any, turns: Any, i_period: int, memory: Any, record: Any, measures: Any, settings: Any) -> int:
    """Add the growth rates of one drive period to the sums for its block, and to the weighted sums over all periods."""
    n_vectors = N_TANGENTS // N_BASE
    i = i_period - settings.n_transient
    n_periods = settings.n_blocks * settings.periods_per_block
    if i > 0:
        block = (i - 1) // settings.periods_per_block
        if (i - 1) % settings.periods_per_block == 0:
            for k in range(n_vectors + 1 + HAS_RETURNS):
                record[block, k] = 0.0
        middle = (i - 0.5) / n_periods
        weight = exp(4.0 - 1.0 / (middle * (1.0 - middle)))
        for k in range(n_vectors + 1):
            record[block, k] += memory[k]
            measures[k] += weight * memory[k]
        if HAS_RETURNS:
            record[block, n_vectors + 1] += memory[len(memory) - 1]
            measures[n_vectors + 1] += weight * memory[len(memory) - 1]
        else:
            measures[n_vectors + 1] += weight
        measures[n_vectors + 2] = max(measures[n_vectors + 2], memory[n_vectors + 1])
    for k in range(n_vectors + 2):
        memory[k] = 0.0
    return BOUNDED if i == n_periods else PENDING


@inline
def _memory_size(settings: Any, n_states: int) -> int:
    return n_states + 1


def _observer(n: int, n_vectors: int, has_returns: bool) -> Observer:
    bindings = {"N_BASE": n, "N_TANGENTS": n * n_vectors, "HAS_RETURNS": has_returns}
    name = "lyapunov_returns" if has_returns else "lyapunov"
    return Observer(name, _average, _memory_size, bindings, _orthonormalise, SHRUNK)


def lyapunov_exponents(
    parameters: np.ndarray,
    frequency_hz: np.ndarray,
    states: np.ndarray,
    *,
    n_exponents: int | None = None,
    n_transient: int = 200,
    n_periods: int = 400,
    n_blocks: int = 16,
    rtol: float = RTOL,
    atol: float = ATOL,
    max_steps_per_period: int = MOST_STEPS,
    system: System,
    n_lanes: int = N_LANES,
) -> LyapunovExponents:
    """Estimate the largest Lyapunov exponents along trajectories.

    The trajectories should be on their attractors. What an exponent's standard error covers is the
    spread between blocks: it is honest for chaos when blocks are longer than the correlations, and an
    upper bound for closed orbits, where the plain average misses the logarithms of the multipliers by up
    to some 3/`n_periods` per drive period. There the weighted average is better by far: its weights
    exp(-1/(t (1 - t))) fall to zero at both ends, so that what oscillates cancels (Das et al.,
    Nonlinearity 30 (2017) 4111-4140).

    While a joint sticks, its velocity decays within a millisecond, and the last exponent is as rough as
    the steps are long. The sum of a full spectrum then misses `divergence`: with the preset at a tolerance
    of 1e-8 by 1e-6 /s in the median and 3e-3 /s at most above 0.3 Hz, by 0.1 /s at 0.1 Hz. A smaller
    tolerance cures it.

    Parameters
    ----------
    parameters
        Packed parameters, shape (cell, len(system.parameter_names)) [SI].
    frequency_hz
        Drive frequency, shape (cell,) [Hz].
    states
        States at a rising edge of the drive, shape (cell, n_states) [rad, rad/s].
    n_exponents
        How many, from the largest; None for all, one per state.
    n_transient
        Drive periods in which the tangent vectors turn into their directions.
    n_periods
        Drive periods of the average; a multiple of `n_blocks`.
    n_blocks
        Blocks for the standard errors, at least 2.
    rtol, atol, max_steps_per_period, system, n_lanes
        As for `run_branches`.

    Returns
    -------
    LyapunovExponents
        In the order of the cells; a cell's numbers depend on that cell alone.

    Raises
    ------
    ValueError
        If an argument has the wrong shape or is out of bounds, or the system has more than
        `sizes.MAX_STATES` states.

    Notes
    -----
    Between two edges of the drive the first tangent vector outgrows the last by exp((l1 - ln) t): with
    l1 - l4 = 4 /s, chaos of the preset at 1 Hz, double precision would suffice down to 0.07 Hz. `loss`
    tells.
    """
    frequency = check_frequency(frequency_hz, 1)
    packed = check_array("parameters", parameters, 2)
    start = check_states(states, 2, system.n_states, "states")
    if not len(packed) == len(frequency) == len(start):
        raise ValueError(
            f"parameters, frequency_hz and states have {len(packed)}, {len(frequency)} and {len(start)} "
            "rows; they must agree."
        )
    n_exponents = system.n_states if n_exponents is None else n_exponents
    settings = _settings(n_exponents, n_transient, n_periods, n_blocks, system)
    n, has_returns = system.n_states, system.section is not None
    extended = with_tangents(system, n_exponents, divergence=True)
    extended = dataclasses.replace(extended, n_controlled=n * (1 + n_exponents))

    def averaged(own: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        cells = integrate(
            extended,
            _observer(n, n_exponents, has_returns),
            settings,
            parameters=packed[own, None],
            frequency_hz=frequency[own, None],
            initial_states=_with_vectors(start[own], n_exponents, system),
            n_keep=n_blocks,
            n_measures=n_exponents + 3,
            rtol=rtol,
            atol=atol,
            max_steps_per_period=max_steps_per_period,
            n_lanes=n_lanes,
        )
        return cells.section[:, 0, :, : n_exponents + 2].copy(), cells.measures[:, 0], cells.status[:, 0]

    parts = [averaged(own) for own in _parts(len(frequency), extended.n_states * n_blocks, n_lanes)]
    record, all_measures, status = (np.concatenate(column) for column in zip(*parts, strict=True))
    by_drive = (settings.periods_per_block / frequency)[:, None]
    seconds = record[:, :, n_exponents + 1] if has_returns else by_drive
    sums = record / seconds[:, :, None]
    # where blocks last differently long, the longer one counts for more
    shares = seconds / seconds.mean(axis=1, keepdims=True) if has_returns else np.ones((1, 1))
    means = (sums[:, :, :n_exponents] * shares[:, :, None]).mean(axis=1)
    order = np.argsort(-means, axis=1, kind="stable")
    blocks = np.take_along_axis(sums[:, :, :n_exponents], order[:, None, :], axis=2)
    measures = np.where(status[:, None] == BOUNDED, all_measures, np.nan)
    is_known = not system.is_map or n <= WRITTEN_OUT_MAPS
    per_weight = np.ones_like(frequency) if has_returns else frequency
    weighted = measures[:, :n_exponents] / measures[:, n_exponents + 1, None] * per_weight[:, None]
    return LyapunovExponents(
        exponents=np.take_along_axis(means, order, axis=1),
        stderr=blocks.std(axis=1, ddof=1) / np.sqrt(settings.n_blocks),
        weighted=np.take_along_axis(weighted, order, axis=1),
        blocks=blocks,
        divergence=np.where(is_known, (sums[:, :, n_exponents] * shares).mean(axis=1), np.nan),
        loss=measures[:, n_exponents + 2],
        status=status.astype(np.int8),
        is_whole=n_exponents == n,
    )


def _parts(n_cells: int, per_cell: int, n_lanes: int) -> list[slice]:
    """Return slices that split the trajectories into groups small enough for memory, to be integrated one after the
    other.
    """
    most = max(n_lanes, MOST_NUMBERS // per_cell // n_lanes * n_lanes)
    return [slice(i, i + most) for i in range(0, max(n_cells, 1), most)]


def _settings(n_exponents: int, n_transient: int, n_periods: int, n_blocks: int, system: System) -> _Settings:
    if not 1 <= check_count("n_exponents", n_exponents, 1) <= system.n_states:
        raise ValueError(f"n_exponents = {n_exponents} is out of bounds: it must be at most {system.n_states}.")
    n_transient, n_blocks = check_count("n_transient", n_transient, 0), check_count("n_blocks", n_blocks, 2)
    if check_count("n_periods", n_periods, 2) % n_blocks:
        raise ValueError(
            f"n_periods = {n_periods} must be a multiple of n_blocks = {n_blocks}; "
            f"give {-(-n_periods // n_blocks) * n_blocks}."
        )
    return _Settings(n_transient, n_blocks, n_periods // n_blocks)


def _with_vectors(states: np.ndarray, n_vectors: int, system: System) -> np.ndarray:
    """Append to each state the first unit vectors (of the sizes) as tangent vectors, and a 0 for the integral of the
    divergence.
    """
    n = states.shape[1]
    vectors = np.broadcast_to(LENGTH * np.diag(system.sizes)[:n_vectors].ravel(), (len(states), n * n_vectors))
    return np.concatenate([states, vectors, np.zeros((len(states), 1))], axis=1)
