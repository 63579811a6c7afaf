"""Reduce a flow to the centre manifold of an equilibrium, in normal form: coefficients of bifurcations of equilibria.

The manifold x = H(w) and the normal form w' = G(w) solve ``f(H(w)) = H'(w) G(w)``, degree by degree (Kuznetsov, SIAM
J. Numer. Anal. 36, 1999, 1104; Elements of Applied Bifurcation Theory, 3rd ed., 2004, Ch. 8). The terms of ``f(H)`` are
those of power series (`magpend_core.jets`), so that no derivative is a difference. All in units of the states, with
``|q| = 1``, ``<p, q> = 1``:

=================== ========================================================================== =======================
point               normal form                                                                coefficients
=================== ========================================================================== =======================
cusp                w' = c w^3                                                                 c [1/s]
degenerate          w' = quintic w^5                                                           quintic [1/s]
pitchfork
Bogdanov-Takens     w0' = w1, w1' = a w0^2 + b w0 w1, a > 0                                    a [1/s2], b [1/s]
generalised Hopf    w' = i omega w + c1 w |w|^2 + c2 w |w|^4                                   lyapunov2 = Re c2 / omega
zero-Hopf           x' = b x^2 + c |z|^2 + ..., z' = i omega z + d x z + e x^2 z, after a      s = sign(b c),
                    change of time                                                             theta = Re d / b, e [1/s]
double Hopf         z1' = i omega1 z1 + p11 z1 |z1|^2 + p12 z1 |z2|^2, z2' alike, of which     p11, p22 [1/s],
                    the real parts                                                             theta = p12 / p22,
                                                                                               delta = p21 / p11
=================== ========================================================================== =======================
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from magpend_core.jets import Monomials, monomials, rates_on
from pipeline.analysis.branches.problems import Family

NO_TERM = 1e-9
"""Relative size of a coefficient that counts as 0: a ratio to it has no meaning."""


@dataclass(frozen=True, eq=False)
class Rest:
    """An equilibrium: its unknowns, and the Jacobian there."""

    family: Family
    u: np.ndarray
    jacobian: np.ndarray

    @property
    def units(self) -> np.ndarray:
        """Units of the states: not the extent of a run's motion, on which a coefficient must not depend."""
        return np.asarray(self.family.system.units)

    @property
    def matrix(self) -> np.ndarray:
        """Jacobian [1/s] of states in their units."""
        return np.asarray(self.jacobian * self.units / self.units[:, None])

    def rates(self, of: Monomials, states: np.ndarray) -> np.ndarray:
        """Return the rates, in units of the states, on such states that are power series."""
        units, row = self.units[:, None], self.family.rows(self.u[None])
        states = np.concatenate([row.states.T, states[:, 1:] * units], axis=1)
        return np.asarray(rates_on(self.family.system, row.parameters[0], of, states) / units)

    def second(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the second derivative B(a, b) of the rates along two vectors."""
        of = monomials(2, 2)
        states = np.zeros((len(a), len(of.exponents)), complex)
        states[:, 1], states[:, 2] = a, b
        return self.rates(of, states)[:, of.position((1, 1))]


def solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve linear equations, of one matrix or of several; NaN if a matrix is singular."""
    try:
        return np.asarray(np.linalg.solve(matrix, right))
    except np.linalg.LinAlgError:
        return np.full(matrix.shape[:-1], np.nan)


def null_vectors(matrix: np.ndarray, value: complex = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit right and left eigenvector q, p of an eigenvalue that is nearest to the given one."""
    left, _, right = np.linalg.svd(matrix - value * np.eye(len(matrix)))
    return right[-1].conj(), left[:, -1]


def normal_form(rest: Rest, values: Sequence[complex], order: int) -> dict[tuple[int, tuple[int, ...]], complex]:
    """Compute the normal form on the centre manifold of an equilibrium, by a power series up to some order.

    Critical eigenvalues are 0 or imaginary: at most one 0, and each pair as i omega, -i omega. Returns the coefficient
    of each resonant monomial, by exponents, in the equation of each critical eigenvalue.
    """
    n, m = len(rest.matrix), len(values)
    of = monomials(m, order)
    degrees, turns = of.degrees, _turns(values)
    states, flow = (np.zeros((k, len(of.exponents)), complex) for k in (n, m))
    left = np.zeros((n, m), complex)
    for i, value in enumerate(values):
        q, p = null_vectors(rest.matrix, value)
        if value.imag < 0.0:
            q, p = states[:, i].conj(), left[:, i - 1].conj()
        else:
            p = p / np.vdot(p, q).conj()
        states[:, 1 + i], left[:, i], flow[i, 1 + i] = q, p, value
    found = {}
    for degree in range(2, order + 1):
        known = rest.rates(of, states) - _carried(of, states, flow)
        for k in np.flatnonzero(degrees == degree):
            exponents = of.exponents[k]
            along = [i for i in range(m) if (turns[i] == exponents @ turns).all()]
            rotation = complex(exponents @ np.asarray(values))
            border = states[:, [1 + i for i in along]]
            system = np.block(
                [
                    [rest.matrix - rotation * np.eye(n), -border],
                    [left[:, along].conj().T, np.zeros((len(along), len(along)))],
                ]
            )
            solution = solved(system, np.append(-known[:, k], np.zeros(len(along))))
            states[:, k], flow[along, k] = solution[:n], solution[n:]
            found.update({(i, tuple(exponents.tolist())): complex(flow[i, k]) for i in along})
    return found


def _turns(values: Sequence[complex]) -> np.ndarray:
    """Return for each critical eigenvalue how often it contains each of the frequencies."""
    frequencies = [v for v in values if v.imag > 0.0]
    turns = np.zeros((len(values), max(1, len(frequencies))), int)
    for i, value in enumerate(values):
        for j, own in enumerate(frequencies):
            turns[i, j] = int(value == own) - int(value == own.conjugate())
    return turns


def _carried(of: Monomials, states: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """Return the series of H'(w) G(w)."""
    found = np.zeros_like(states)
    at = {tuple(e): k for k, e in enumerate(of.exponents.tolist())}
    ones = np.eye(len(flow), dtype=int)
    for i, own in enumerate(flow):
        slope = np.zeros_like(states)
        for k, exponents in enumerate(of.exponents):
            if exponents[i]:
                slope[:, at[tuple((exponents - ones[i]).tolist())]] = exponents[i] * states[:, k]
        found += of.times(slope, own)
    return found


# ---- coefficients ------------------------------------------------------------------------------


def cusp(rest: Rest) -> dict[str, float]:
    """Return the cubic coefficient c of a cusp."""
    return {"c": normal_form(rest, [0j], 3)[0, (3,)].real}


def degenerate_pitchfork(rest: Rest) -> dict[str, float]:
    """Return the coefficient of the fifth degree of a pitchfork without a cubic term."""
    return {"quintic": normal_form(rest, [0j], 5)[0, (5,)].real}


def bogdanov_takens(rest: Rest) -> dict[str, float]:
    """Return the coefficients a and b of a Bogdanov-Takens point (Kuznetsov 2004, Eqs. 8.51 and 8.52)."""
    q0, p1 = null_vectors(rest.matrix)
    bordered = np.block([[rest.matrix, p1[:, None]], [q0[None], np.zeros((1, 1))]])
    q1 = solved(bordered, np.append(q0, 0.0))[:-1]
    p1 = p1 / (p1 @ q1)
    p0 = solved(bordered.T, np.append(p1, 0.0))[:-1]
    p0 = p0 - (p0 @ q1) * p1
    square = rest.second(q0, q0).real
    a = float(0.5 * p1 @ square)
    b = float(p0 @ square + p1 @ rest.second(q0, q1).real)
    norm = float(np.linalg.norm(rest.matrix))
    a, b = (value if abs(value) > least else 0.0 for value, least in ((a, NO_TERM * norm**2), (b, NO_TERM * norm)))
    return {"a": abs(a), "b": float(b * np.copysign(1.0, a))}


def lyapunov(rest: Rest, omega: float, order: int = 3) -> list[float]:
    """Return the first Lyapunov coefficient of a Hopf point, and the second one if `order` is 5."""
    found = normal_form(rest, [1j * omega, -1j * omega], order)
    return [found[0, (k + 1, k)].real / omega for k in range(1, (order + 1) // 2)]


def zero_hopf(rest: Rest, omega: float) -> dict[str, float]:
    """Return the coefficients of a zero-Hopf point (Kuznetsov 2004, Eqs. 8.82 to 8.86)."""
    g = normal_form(rest, [0j, 1j * omega, -1j * omega], 3)
    b, c = g[0, (2, 0, 0)].real, g[0, (0, 1, 1)].real
    d, cubic, mixed = g[1, (1, 1, 0)], g[0, (3, 0, 0)].real, g[0, (1, 1, 1)].real
    h021, h210 = g[1, (0, 2, 1)], g[1, (2, 1, 0)]
    if min(abs(b), abs(c)) < NO_TERM * max(abs(b), abs(c), abs(d)):  # as where the motion has a mirror image
        return dict.fromkeys(("s", "theta", "e"), np.nan)
    e = (h210 + d * (h021.real / c - 1.5 * cubic / b + 0.5 * mixed / c) - h021 * b / c).real
    return {"s": float(np.sign(b * c)), "theta": d.real / b, "e": e}


def double_hopf(rest: Rest, first: float, second: float) -> dict[str, float]:
    """Return the coefficients of a double Hopf point (Kuznetsov 2004, Eqs. 8.110 and 8.112)."""
    g = normal_form(rest, [1j * first, -1j * first, 1j * second, -1j * second], 3)
    p11, p12 = g[0, (2, 1, 0, 0)].real, g[0, (1, 0, 1, 1)].real
    p21, p22 = g[2, (1, 1, 1, 0)].real, g[2, (0, 0, 2, 1)].real
    least = NO_TERM * max(map(abs, (p11, p12, p21, p22)))
    theta, delta = (a / b if abs(b) > least else np.nan for a, b in ((p12, p22), (p21, p11)))
    return {"p11": p11, "p22": p22, "theta": theta, "delta": delta}
