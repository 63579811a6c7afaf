"""Define the equations for equilibria of flows along a parameter, and the test function for their Hopf points."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from magpend_core.pointwise import jacobian_at, rates_at
from pipeline.analysis.branches.problems import (
    PARAMETER_STEP,
    STATE_STEP,
    Ends,
    Family,
    FamilyProblem,
    OrbitProblem,
    Rows,
    Value,
)


@dataclass(eq=False)
class EquilibriumProblem(FamilyProblem):
    """Equations for the equilibria of a flow along one free parameter. Their value needs no integration."""

    family: Family
    _unit: float = field(default=0.0, init=False, repr=False)

    def rows(self, u: np.ndarray) -> Rows:
        """Return no trajectories to integrate: the equations for equilibria need none."""
        return self.family.rows(u[None][:0])

    def value(self, u: np.ndarray, ends: Ends) -> Value:
        """Compute the scaled rates at a state, and their derivatives with respect to the state and the parameter."""
        step = np.zeros(self.size)
        step[-1] = PARAMETER_STEP
        rows, scales = self.family.rows(np.stack([u, u + step, u - step])), np.asarray(self.system.scales)
        rates = [rates_at(self.system, rows.states[:1], p)[0] / scales for p in rows.parameters]
        jacobian = jacobian_at(self.system, rows.states[:1], rows.parameters[0])[0]
        slope = (rates[1] - rates[2]) / (2.0 * PARAMETER_STEP)
        unit = self._unit_of(jacobian)
        derivative = np.column_stack([self.family.scaled(jacobian), slope]) * unit
        return Value(rates[0] * unit, derivative, rows.states[:1], jacobian, is_rest=True)

    def _unit_of(self, jacobian: np.ndarray) -> float:
        """Return the time [s] that makes the rates dimensionless: the inverse of the Jacobian's norm at the first
        call.
        """
        if not self._unit:
            norm = float(np.linalg.norm(self.family.scaled(jacobian)))
            self._unit = 1.0 / norm if norm > 0.0 and np.isfinite(norm) else 1.0
        return self._unit


@dataclass(frozen=True, eq=False)
class HopfProblem(FamilyProblem):
    """Equations for equilibria at a Hopf point, with two free parameters: the rates and `hopf_test` are zero."""

    n_free = 2
    family: Family

    def rows(self, u: np.ndarray) -> Rows:
        """Return no trajectories to integrate: the equations for equilibria need none."""
        return self.family.rows(u[None][:0])

    def value(self, u: np.ndarray, ends: Ends) -> Value:
        """Compute the scaled rates and the Hopf test function, and their derivatives by central differences."""
        n, scales = self.family.system.n_states, np.asarray(self.system.scales)
        steps = np.array([STATE_STEP] * n + [PARAMETER_STEP] * 2)
        rows = self.family.rows(np.concatenate([u[None], u + np.diag(steps), u - np.diag(steps)]))
        at = list(zip(rows.states[:, None], rows.parameters, strict=True))
        jacobians = [jacobian_at(self.system, state, p)[0] for state, p in at]
        norm = float(np.linalg.norm(self.family.scaled(jacobians[0]))) or 1.0
        tests = np.array([hopf_test(j) if np.isfinite(j).all() else np.nan for j in jacobians])
        rates = np.array([rates_at(self.system, state, p)[0] for state, p in at]) / scales / norm
        both = np.column_stack([rates, tests])
        derivative = (both[1 : 1 + self.size] - both[1 + self.size :]).T / (2.0 * steps)
        return Value(both[0], derivative, rows.states[:1], jacobians[0], is_rest=True)


OneParameter = OrbitProblem | EquilibriumProblem
"""The problems with one free parameter, whose solutions are branches."""


def hopf_test(jacobian: np.ndarray) -> float:
    """Compute the product of the normalised sums of all pairs of eigenvalues; it is zero at a Hopf point."""
    values = np.linalg.eigvals(jacobian)
    i, j = np.triu_indices(len(values), 1)
    sums, sizes = values[i] + values[j], np.abs(values[i]) + np.abs(values[j])
    return float(np.prod(sums / np.where(sizes > 0.0, sizes, 1.0)).real)
