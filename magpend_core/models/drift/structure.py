"""Find out which constants of a system move with its parameters, and how finely their motion must be divided.

The functions of the system are run in plain Python at a few values; nothing is compiled.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from magpend_core.engine.plain_python import plain
from magpend_core.engine.system import System
from magpend_core.models.drift.ramps import TABLE, RampOfCells, value_at
from magpend_core.models.drift.system import AFFINE, DEGREE, Moving, coefficients_of, nodes_of

N_VALUES = 9
"""Values of each moving parameter at which the constants are compared."""

RESOLVED, LINEAR_TO = 1e-13, 1e-14
"""Largest error of the interpolation, and of a line where the constants count as linear; relative to their size."""

MOST_PIECES = 4096
"""Most parts into which a ramp is divided."""

MOST_CELLS = 4
"""Cells at which the interpolation is tried."""


class DriftError(ValueError):
    """Error: a parameter of a system cannot move, or its motion cannot be resolved.

    Attributes
    ----------
    parameter : str
        Its name.
    """

    def __init__(self, parameter: str, problem: str) -> None:
        self.parameter = parameter
        super().__init__(problem)


class _Probe:
    """A system's constants, edges and surfaces as functions of its parameters, in plain Python."""

    def __init__(self, system: System, motions: Sequence[RampOfCells], packed: np.ndarray, hz: np.ndarray) -> None:
        self.system, self.motions, self.hz = system, motions, hz
        self.places = tuple(system.parameter_names.index(m.ramp.parameter) for m in motions)
        self.packed = np.ascontiguousarray(packed[:, : len(system.parameter_names)])
        self._constants, self._edges = plain(system.constants), plain(system.edges)

    def parameters(self, cell: int, values: Sequence[float]) -> np.ndarray:
        """Return the parameters of a cell with given values of those that move."""
        p = np.array(self.packed[cell])
        p[list(self.places)] = values
        return p

    def constants(self, cell: int, values: Sequence[float]) -> np.ndarray:
        """Return the constants of a cell with given values of the parameters that move."""
        out = np.zeros(self.system.n_constants)
        with np.errstate(all="ignore"):
            self._constants(np.float64(self.hz[cell]), self.parameters(cell, values), out)
        return out

    def edge_times(self, cell: int, values: Sequence[float]) -> np.ndarray:
        """Return the times of the drive's edges in a period [s]."""
        table = np.zeros((3, self.system.n_edges))
        with np.errstate(all="ignore"):
            self._edges(np.float64(self.hz[cell]), self.parameters(cell, values), *table)
        return np.array(table[0])

    def surfaces(self, cell: int, values: Sequence[float]) -> np.ndarray:
        """Return the values of all switches and impacts at some states and times."""
        own = self.constants(cell, values)
        rng = np.random.default_rng(5)
        found: list[float] = []
        modes = np.ones(self.system.n_modes)
        for name in ("switches", "impacts"):
            function = getattr(self.system, name)
            if function is None:
                continue
            for _ in range(4):
                y, dy = rng.normal(size=(2, self.system.n_states)) * np.asarray(self.system.units)
                t = float(rng.random() / self.hz[cell])
                pairs = plain(function)(np.float64(t), tuple(y), tuple(dy), (*own, *modes))
                found += [float(value) for value, _ in pairs]
        return np.asarray(found)

    def at_shares(self, cell: int, which: int, shares: np.ndarray) -> list[list[float]]:
        """Return values of the moving parameters: one of them along its ramp, the others at its begin."""
        motion = self.motions[which]
        if motion.ramp.shape == TABLE:
            low, high = min(motion.ramp.values), max(motion.ramp.values)
            moved = low * (1.0 - shares) + high * shares
        else:
            moved = value_at(motion.ramp, motion.begin[cell], motion.end[cell], shares)
        first = [float(m.begin[cell]) for m in self.motions]
        return [[float(v) if i == which else x for i, x in enumerate(first)] for v in moved]


def moving_of(system: System, motions: Sequence[RampOfCells], packed: np.ndarray, frequency_hz: np.ndarray) -> Moving:
    """Return what moves in a system.

    Parameters
    ----------
    system
        The system without its moving parameters' motion.
    motions
        Of cells that stand for all: the ends of each range of values.
    packed
        Parameters of these cells, beginning with those of the system, shape (cell, n).
    frequency_hz
        Shape (cell,) [Hz].

    Raises
    ------
    DriftError
        If a parameter moves the edges of the drive or a surface of events.
    """
    probe = _Probe(system, motions, packed, frequency_hz)
    cells = range(len(packed))
    shares = np.linspace(0.0, 1.0, N_VALUES)
    moved: set[int] = set()
    for which in range(len(motions)):
        own: set[int] = set()
        for cell in cells:
            first, *others = [probe.constants(cell, v) for v in probe.at_shares(cell, which, shares)]
            own |= {int(k) for other in others for k in np.flatnonzero(other != first)}
        _check_edges(probe, which, shares)
        _check_surfaces(probe, which)
        moved |= own
    constants = tuple(sorted(moved)) or (0,)
    smooth = tuple(m.ramp.is_smooth for m in motions)
    chosen = _chosen(len(packed))
    affine = len(motions) == 1 and not smooth[0] and all(_is_affine(probe, cell, shares) for cell in chosen)
    return Moving(probe.places, smooth, constants, AFFINE if affine else DEGREE)


def pieces_of(
    system: System, moving: Moving, motions: Sequence[RampOfCells], packed: np.ndarray
) -> list[tuple[int, ...]]:
    """Return for each cell the number of equal parts into which each of its ramps must be divided.

    It depends on the cell's parameters alone. See `Motion.corners`.

    Raises
    ------
    DriftError
        If a parameter moves too far for the interpolation.
    """
    if moving.degree == AFFINE:
        return [(1,) * len(motions)] * len(packed)
    # the frequency scales constants; it does not bend them
    probe = _Probe(system, motions, packed, np.ones(len(packed)))
    known: dict[bytes, tuple[int, ...]] = {}
    found = []
    for cell in range(len(packed)):
        ends = np.array([(m.begin[cell], m.end[cell]) for m in motions])
        key = ends.tobytes() + np.delete(probe.packed[cell], list(probe.places)).tobytes()
        if key not in known:
            known[key] = tuple(_pieces(probe, which, cell, moving.constants) for which in range(len(motions)))
        found.append(known[key])
    return found


def _chosen(n: int) -> list[int]:
    return sorted({int(i) for i in np.linspace(0, n - 1, min(n, MOST_CELLS))})


def _check_edges(probe: _Probe, which: int, shares: np.ndarray) -> None:
    name = probe.motions[which].ramp.parameter
    if not probe.system.n_edges:
        return
    for cell in range(len(probe.packed)):
        times = [probe.edge_times(cell, v) for v in probe.at_shares(cell, which, shares)]
        if any(not np.array_equal(times[0], other) for other in times[1:]):
            raise DriftError(name, f"{name} sets the instants at which the drive switches, which cannot move.")


def _check_surfaces(probe: _Probe, which: int) -> None:
    name = probe.motions[which].ramp.parameter
    if probe.system.switches is None and probe.system.impacts is None:
        return
    first, last = probe.at_shares(0, which, np.array([0.0, 0.7]))
    if not np.array_equal(probe.surfaces(0, first), probe.surfaces(0, last)):
        raise DriftError(
            name, f"{name} sets where a switch or an impact of the model happens, and such a surface cannot move."
        )


def _is_affine(probe: _Probe, cell: int, shares: np.ndarray) -> bool:
    """Return whether all constants are linear functions of the parameter."""
    values = np.array([probe.constants(cell, v) for v in probe.at_shares(cell, 0, shares)])
    line = values[0] * (1.0 - shares[:, None]) + values[-1] * shares[:, None]
    size = np.abs(values).max(axis=0)
    return bool((np.abs(values - line) <= LINEAR_TO * size).all())


def _pieces(probe: _Probe, which: int, cell: int, constants: Sequence[int]) -> int:
    """Return into how many equal parts a ramp must be divided, a power of two."""

    def along(shares: np.ndarray) -> np.ndarray:
        return np.array([probe.constants(cell, v)[list(constants)] for v in probe.at_shares(cell, which, shares)])

    size = np.abs(along(np.linspace(0.0, 1.0, 33))).max(axis=0)
    for power in itertools.count():
        n = int(2**power)
        if n > MOST_PIECES:
            name = probe.motions[which].ramp.parameter
            raise DriftError(
                name,
                f"{name} moves so far that the model's constants, which are computed from it, cannot be interpolated "
                f"to {RESOLVED:g} with {MOST_PIECES} parts of its ramp; move it less.",
            )
        if all(_error(along, part, n, size) <= 1.0 for part in sorted({int(k) for k in np.linspace(0, n - 1, 9)})):
            return n
    raise AssertionError


def _error(along: Callable[[np.ndarray], np.ndarray], part: int, n: int, size: np.ndarray) -> Any:
    """Return the interpolation's largest error between the nodes of one part of a ramp, over what is allowed."""
    nodes = np.array(nodes_of(DEGREE))
    between = 0.5 * (nodes[1:] + nodes[:-1])
    values = along((part + 0.5 + 0.5 * nodes) / n)
    wanted = along((part + 0.5 + 0.5 * between) / n)
    matrix = np.array(coefficients_of(DEGREE))
    middle = values[DEGREE // 2]
    coefficients = (matrix[:, :, None] * (values - middle)[None]).sum(axis=1)
    found = middle + (coefficients[None] * between[:, None, None] ** np.arange(DEGREE + 1)[None, :, None]).sum(axis=1)
    with np.errstate(all="ignore"):
        return np.nan_to_num((np.abs(found - wanted) / np.maximum(RESOLVED * size, 1e-300)).max(), nan=np.inf)
