"""Periodic orbits by collocation at Gauss points, with numpy and scipy alone, and a branch of them over a parameter.

An orbit is a polynomial of degree 4 on each interval of a mesh over its period (Doedel, Keller and Kernevez, Int. J.
Bifurc. Chaos 1, 1991, 493-520 and 745-772): the unknowns are its values, the period and the parameter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import Polynomial
from numpy.polynomial.legendre import leggauss
from scipy.optimize import brentq
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import SuperLU, splu

Rates = Callable[[np.ndarray, complex], np.ndarray]
"""From states (n, points) and the parameter to their derivatives by time; also of complex numbers."""

DEGREE = 4
STEP = 1e-30
"""Derivatives are imaginary parts at this distance (Squire and Trapp, SIAM Rev. 40, 1998, 110), exact to rounding."""

NODES = np.arange(DEGREE + 1) / DEGREE
GAUSS = 0.5 + 0.5 * leggauss(DEGREE)[0]
BASE = [Polynomial.fromroots(np.delete(NODES, j)) for j in range(DEGREE + 1)]
BASE = [p / p(NODES[j]) for j, p in enumerate(BASE)]
VALUES, SLOPES = (np.array([[p(s) for p in q] for s in GAUSS]) for q in (BASE, [p.deriv() for p in BASE]))
HIGHEST = np.array([p.coef[-1] for p in BASE])


@dataclass(frozen=True)
class Orbit:
    """Values at the nodes of all intervals (points, n), the period and the parameter; with the branch's direction."""

    mesh: np.ndarray
    values: np.ndarray
    period: float
    parameter: float
    direction: np.ndarray

    @property
    def unknowns(self) -> np.ndarray:
        return np.concatenate([self.values.ravel(), [self.period, self.parameter]])

    def at(self, unknowns: np.ndarray) -> Orbit:
        return replace(
            self, values=unknowns[:-2].reshape(self.values.shape), period=unknowns[-2], parameter=unknowns[-1]
        )

    def pieces(self, values: np.ndarray) -> np.ndarray:
        """Values at nodes by interval, shape (intervals, DEGREE + 1, n)."""
        index = DEGREE * np.arange(len(self.mesh) - 1)[:, None] + np.arange(DEGREE + 1)
        return values[index]


def operator(rates: Rates, orbit: Orbit) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the mismatch at Gauss points, and its derivatives by values, period and parameter.

    Shapes (intervals, DEGREE, n), with (DEGREE + 1, n) more for the values.
    """
    pieces, n = orbit.pieces(orbit.values), orbit.values.shape[1]
    inside = np.einsum("kj,ijs->iks", VALUES, pieces)
    flat = inside.reshape(-1, n).T
    f = rates(flat, orbit.parameter).real.T.reshape(inside.shape)
    shifts = STEP * 1j * np.eye(n)
    by_state = np.stack([rates(flat + e[:, None], orbit.parameter).imag.T / STEP for e in shifts], axis=-1)
    by_parameter = rates(flat.astype(complex), orbit.parameter + STEP * 1j).imag.T.reshape(inside.shape) / STEP
    widths = np.diff(orbit.mesh)[:, None, None]
    mismatch = np.einsum("kj,ijs->iks", SLOPES, pieces) - orbit.period * widths * f
    blocks = np.einsum("kj,sr->ksjr", SLOPES, np.eye(n))[None] - orbit.period * widths[..., None, None] * np.einsum(
        "ikab,kj->ikajb", by_state.reshape(*inside.shape, n), VALUES
    )
    return mismatch, blocks, -widths * f, -orbit.period * widths * by_parameter


def matrix(
    orbit: Orbit, blocks: np.ndarray, sign: float, columns: list[np.ndarray], rows: list[np.ndarray]
) -> csc_matrix:
    """Return the matrix of collocation, of closing (the end is `sign` times the start) and of full columns and rows."""
    size, n = orbit.values.size, orbit.values.shape[1]
    i, k, a, j, b = np.indices(blocks.shape)
    row, column = (i * DEGREE + k) * n + a, (i * DEGREE + j) * n + b
    ends = size - n + np.arange(n)
    parts = [
        (row.ravel(), column.ravel(), blocks.ravel()),
        (ends, ends, np.ones(n)),
        (ends, np.arange(n), np.full(n, -sign)),
    ]
    for at, values in enumerate(columns):
        parts.append((np.arange(len(values)), np.full(len(values), size + at), values))
    for at, values in enumerate(rows):
        parts.append((np.full(len(values), size + at), np.arange(len(values)), values))
    r, c, v = (np.concatenate(x) for x in zip(*parts, strict=True))
    return csc_matrix((v, (r, c)), shape=(size + len(rows), size + len(columns)))


def corrected(rates: Rates, guess: Orbit, plane: np.ndarray, phase: np.ndarray) -> Orbit | None:
    """Return the orbit near a guess in a plane, in step with `phase`; None unless Newton's method converges fast."""
    found, start = guess, guess.unknowns
    for _ in range(8):
        mismatch, blocks, by_period, by_parameter = operator(rates, found)
        closing = found.values[-1] - found.values[0]
        moved = found.unknowns - start
        off = np.concatenate([mismatch.ravel(), closing, [phase @ moved[:-2], plane @ moved]])
        columns = [np.concatenate([x.ravel(), np.zeros(len(closing)), np.zeros(2)]) for x in (by_period, by_parameter)]
        system = splu(matrix(found, blocks, 1.0, columns, [phase, plane]))
        change = system.solve(off)
        found = found.at(found.unknowns - change)
        if np.max(np.abs(change)) < 1e-9:
            last = np.zeros(len(off))
            last[-1] = 1.0
            along = system.solve(last)
            return replace(found, direction=along / np.sqrt(weights(found) @ along**2))
    return None


def weights(orbit: Orbit) -> np.ndarray:
    """Of the unknowns in the length along a branch: all values together count as one."""
    return np.concatenate([np.full(orbit.values.size, 1.0 / len(orbit.values)), [1e-2, 1.0]])


def phase_of(orbit: Orbit) -> np.ndarray:
    """The row by which a neighbour is in step with an orbit: no shift along its velocity."""
    velocity = np.gradient(orbit.values, positions(orbit.mesh), axis=0).ravel()
    return velocity / np.linalg.norm(velocity)


def positions(mesh: np.ndarray) -> np.ndarray:
    """Times of all nodes, in periods."""
    return np.append((mesh[:-1, None] + np.diff(mesh)[:, None] * NODES[:-1]).ravel(), mesh[-1])


def remeshed(orbit: Orbit) -> Orbit:
    """Return the orbit on a mesh that spreads its error evenly, as AUTO does (Russell and Christiansen 1978)."""
    widths = np.diff(orbit.mesh)
    slopes = np.einsum("j,ijs->is", HIGHEST, orbit.pieces(orbit.values)) / widths[:, None] ** DEGREE
    around = np.append(widths[-1], widths)
    jumps = np.abs(slopes - np.roll(slopes, 1, axis=0)) / (0.5 * (around[1:] + around[:-1]))[:, None]
    size = np.sum((0.5 * (jumps + np.roll(jumps, -1, axis=0))) ** (2.0 / (DEGREE + 1)), axis=1) ** 0.5
    density = size + 0.05 * np.sum(size * widths)
    total = np.append(0.0, np.cumsum(density * widths))
    mesh = np.interp(np.linspace(0.0, total[-1], len(orbit.mesh)), total, orbit.mesh)
    mesh[0], mesh[-1] = 0.0, 1.0
    times = positions(mesh)
    along = interpolated(orbit, orbit.direction[:-2].reshape(orbit.values.shape), times)
    direction = np.append(along.ravel(), orbit.direction[-2:])
    return Orbit(mesh, interpolated(orbit, orbit.values, times), orbit.period, orbit.parameter, direction)


def interpolated(orbit: Orbit, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Evaluate the polynomials of an orbit's intervals."""
    i = np.clip(np.searchsorted(orbit.mesh, times, side="right") - 1, 0, len(orbit.mesh) - 2)
    s = (times - orbit.mesh[i]) / np.diff(orbit.mesh)[i]
    return np.einsum("tj,tjs->ts", np.array([p(s) for p in BASE]).T, orbit.pieces(values)[i])


def branch(rates: Rates, first: Orbit, length: float, longest: float, n_steps: int) -> Iterator[tuple[Orbit, Orbit]]:
    """Yield pairs of neighbouring orbits along a branch: the second is predicted from the first's direction."""
    orbit = first
    for _ in range(n_steps):
        orbit = remeshed(orbit)
        plane = orbit.direction * weights(orbit)
        phase = phase_of(orbit)
        orbit = corrected(rates, orbit, plane, phase) or orbit
        while (following := ahead(rates, orbit, length)) is None or is_sharp(orbit, following):
            length *= 0.5
        yield orbit, following
        orbit, length = following, min(longest, 1.3 * length)


def is_sharp(orbit: Orbit, following: Orbit) -> bool:
    """Tell whether the branch bends much between two orbits."""
    return float((weights(orbit) * orbit.direction) @ following.direction) < 0.8


def ahead(rates: Rates, orbit: Orbit, length: float) -> Orbit | None:
    """Return the orbit at a length along the branch, on the same mesh and in the same direction."""
    plane = orbit.direction * weights(orbit)
    guess = orbit.at(orbit.unknowns + length * orbit.direction)
    return corrected(rates, guess, plane, phase_of(orbit))


def is_turning(orbit: Orbit) -> float:
    """Vanishes at a fold: how the parameter changes along the branch."""
    return float(orbit.direction[-1])


def is_doubling(rates: Rates, orbit: Orbit) -> Callable[[Orbit], float]:
    """Return a function that vanishes where the linearised equations have a solution that changes sign in a period.

    It is the last unknown of the equations, bordered by their nearly singular vectors at an orbit nearby.
    """
    last = np.append(np.zeros(orbit.values.size), 1.0)

    def bordered(orbit: Orbit, left: np.ndarray, right: np.ndarray) -> SuperLU:
        return splu(matrix(orbit, operator(rates, orbit)[1], -1.0, [left], [right]))

    right, left = np.random.default_rng(0).standard_normal((2, orbit.values.size))
    for _ in range(4):
        both = bordered(orbit, left, right)
        right, left = (x[:-1] / np.linalg.norm(x[:-1]) for x in (both.solve(last), both.solve(last, "T")))
    return lambda orbit: float(bordered(orbit, left, right).solve(last)[-1])


def located(rates: Rates, orbit: Orbit, following: Orbit, function: Callable[[Orbit], float]) -> Orbit | None:
    """Return the orbit between two neighbours where a function vanishes; None where it has one sign."""
    if function(orbit) * function(following) > 0.0:
        return None
    length = float((orbit.direction * weights(orbit)) @ (following.unknowns - orbit.unknowns))

    def at(s: float) -> Orbit:
        found = ahead(rates, orbit, s)
        assert found is not None
        return found

    return at(brentq(lambda s: function(at(s)), 0.0, length, xtol=1e-13 * length, rtol=1e-13))


def near_hopf(rates: Rates, rest: np.ndarray, parameter: float, size: float, n_intervals: int) -> Orbit:
    """Return the circle of eigenvectors about a point at rest with a pair of imaginary eigenvalues."""
    shifts = STEP * 1j * np.eye(len(rest))
    jacobian = rates(rest[:, None] + shifts, parameter).imag / STEP
    values, vectors = np.linalg.eig(jacobian)
    at = int(np.argmin(np.abs(values.real) + 1e3 * (values.imag <= 0.0)))
    mesh = np.linspace(0.0, 1.0, n_intervals + 1)
    turn = 2.0 * np.pi * positions(mesh)[:, None]
    circle = size * np.real(vectors[:, at] / np.abs(vectors[:, at]).max() * np.exp(1j * turn))
    direction = np.append((circle / size).ravel(), [0.0, 0.0])
    made = Orbit(mesh, rest + circle, 2.0 * np.pi / values[at].imag, parameter, direction)
    return replace(made, direction=direction / np.sqrt(weights(made) @ direction**2))
