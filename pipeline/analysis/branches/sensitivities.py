"""Compute how located bifurcations move with the parameters of the model: derivatives, elasticities, deviations.

A bifurcation solves ``G(u, p, theta) = 0``: the orbit closes, or the rates vanish, and a test function is zero. So its
state u and its value p of the continued parameter have the derivatives ``-G_(u,p)^-1 G_theta``; the row of the inverse
that belongs to p serves all parameters (the adjoint).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magpend_core.models.model import Model, Parameters
from magpend_core.pointwise import jacobian_at, rates_at
from magpend_core.sizes import LEVEL
from pipeline.analysis.branches.analysis import fixed_of
from pipeline.analysis.branches.bands import digest_of_draws, draws_of, moving_of
from pipeline.analysis.branches.declaration import SensitivityOptions
from pipeline.analysis.branches.intervals import settle_along
from pipeline.analysis.branches.kinds import BRANCH_POINTS, FOLD, HOPF, LABELS
from pipeline.analysis.branches.lockstep import integrated
from pipeline.analysis.branches.problems import FREQUENCY, TESTS, Family, hopf_test
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import axes_of, axis_name, frequency_of, parameter_name, parameter_units, parameters_of
from pipeline.products.product import Table
from pipeline.products.reporting import track
from pipeline.results.run import OpenRun
from pipeline.results.tabular import Row, Words, aligned, counted, plain, values, words_of
from pipeline.results.tolerances import NO_INFLUENCE
from pipeline.specification.problems import SpecError, unknown_name

Array = NDArray[np.float64]

STEPS = 10.0 ** -np.arange(2.0, 6.5, 0.5)
"""Steps of central differences, in units of the scales. The one is taken at which the extrapolated difference changes
least; the change is its error."""


KNOWN, BREAKS, FAILED = range(3)
STATUSES = ("known", "breaks", "failed")
"""Whether a derivative is known, the branch point does not survive a change of the parameter, or the equations have
no derivative there."""


@dataclass(frozen=True, eq=False)
class Located:
    """A bifurcation with its defining equations.

    The unknowns u are the states, the continued parameter and all others, scaled.
    """

    family: Family  # its free parameters: the continued one first, then all others
    kind: str
    u: Array
    border: Array  # (2, n_states): left and right singular vectors of the equations' derivative by the state
    unit: float = 1.0  # of an equilibrium: time that makes its rates dimensionless [s]

    @property
    def n_states(self) -> int:
        """Number of states."""
        return self.family.system.n_states

    def closure(self, many: Array) -> tuple[Array, Array]:
        """Return the residuals (m, n_states) of orbit or equilibrium at m vectors of unknowns, and the monodromy
        matrices or Jacobians, scaled.
        """
        family, rows = self.family, self.family.rows(many)
        if family.period:
            ends = integrated([rows], family.system)[0]
            gaps = [family.mismatch(u, image) for u, image in zip(many, ends.images[:, -1], strict=True)]
            return np.array(gaps), np.array([family.scaled(m) for m in ends.monodromy])
        scales, at = np.asarray(family.system.scales), list(zip(rows.states[:, None], rows.parameters, strict=True))
        rates = [rates_at(family.system, state, p)[0] / scales for state, p in at]
        slopes = [family.scaled(jacobian_at(family.system, state, p)[0]) for state, p in at]
        return np.array(rates) * self.unit, np.array(slopes) * self.unit

    def by_state(self, matrix: Array) -> Array:
        """Return the derivative of the residual by the state, from a monodromy matrix or a Jacobian."""
        return matrix - np.eye(self.n_states) if self.family.period else matrix

    def equations(self, many: Array) -> Array:
        """Return G at m vectors of unknowns, (m, n_states + 1); of a branch point (m, n_states + 2)."""
        inner = 1e-3  # step of the differences by the continued parameter inside of the test function of a branch point
        gaps, matrices = self.closure(many)
        if self.kind == HOPF:
            return np.column_stack([gaps, [_test(lambda m: hopf_test(np.linalg.eigvals(m)), m) for m in matrices]])
        if self.kind not in (FOLD, *BRANCH_POINTS):
            return np.column_stack([gaps, [_test(TESTS[self.kind], m) for m in matrices]])
        right = np.zeros((len(many), self.n_states + 1, 2))
        right[:, -1, 0] = 1.0
        if self.kind in BRANCH_POINTS:
            step = np.zeros(many.shape[1])
            step[self.n_states] = inner
            around = np.concatenate([many + k * step for k in (-2, -1, 1, 2)])
            far, near, after, beyond = np.split(self.closure(around)[0], 4)
            right[:, :-1, 1] = (far - 8.0 * near + 8.0 * after - beyond) / (12.0 * inner)
        bordered = np.zeros((len(many), self.n_states + 1, self.n_states + 1))
        bordered[:, :-1, :-1] = [self.by_state(m) for m in matrices]
        bordered[:, :-1, -1], bordered[:, -1, :-1] = self.border
        tests = np.linalg.solve(bordered, right)[:, -1]
        return np.column_stack([gaps, tests if self.kind in BRANCH_POINTS else tests[:, :1]])

    def slopes(self, columns: Sequence[int]) -> tuple[Array, Array]:
        """Return the derivatives of G by some of the unknowns, (n_equations, n_columns), and their errors."""
        shifts = STEPS[:, None, None] * np.eye(len(self.u))[list(columns)]
        many = self.u + np.stack([shifts, -shifts])
        found = self.equations(many.reshape(-1, len(self.u))).reshape(*many.shape[:-1], -1)
        differences = (found[0] - found[1]) / (2.0 * STEPS[:, None, None])
        ratio = (STEPS[0] / STEPS[1]) ** 2
        better = differences[1:] + np.diff(differences, axis=0) / (ratio - 1.0)
        changes = np.abs(np.diff(better, axis=0))
        errors = np.maximum(changes[:-1], changes[1:])
        best = np.where(np.isfinite(errors), errors, np.inf).argmin(axis=0)[None]
        value, error = (np.take_along_axis(a, best, axis=0)[0].T for a in (better[1:-1], errors))
        own = [i for i, column in enumerate(columns) if column < self.n_states]
        if own:  # known from tangents
            exact = self.by_state(self.closure(self.u[None])[1][0])
            value[: self.n_states, own] = exact[:, [columns[i] for i in own]]
            error[: self.n_states, own] = 0.0
        return value, error


def _test(test: Any, matrix: Array) -> float:
    return float(test(matrix)) if np.isfinite(matrix).all() else np.nan


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Derivatives of the value of a bifurcation by all parameters, their errors, and their statuses."""

    value: float  # of the continued parameter, after Newton's method
    derivative: Array
    error: Array
    status: NDArray[np.int8]


def sensitivity_of(located: Located) -> Sensitivity:
    """Compute the derivatives of the value of a bifurcation by all parameters.

    Parameters
    ----------
    located
        A bifurcation, near the solution of its equations.
    """
    # largest part of a parameter's derivative of the equations of a branch point that no motion of the point balances
    persists = 1e-5
    n, others = located.n_states, range(located.n_states + 1, len(located.u))
    found = _polished(located)
    if found is None:
        none = np.full(len(others), np.nan)
        return Sensitivity(float(located.family.values(located.u)[0]), none, none, np.full(len(others), FAILED, "int8"))
    matrix, matrix_error = found.slopes(range(n + 1))
    right, right_error = found.slopes(others)
    inverse = np.linalg.pinv(matrix) if np.isfinite(matrix).all() else np.full(matrix.T.shape, np.nan)
    adjoint, moves = inverse[n], -inverse @ right
    error = np.abs(adjoint) @ (right_error + matrix_error @ np.abs(moves))
    left = np.abs(matrix @ moves + right).max(axis=0)
    bound = persists * np.abs(right).max(axis=0) + 10.0 * (right_error + matrix_error @ np.abs(moves)).max(axis=0)
    status = np.where(np.isfinite(error), np.where(left > bound, BREAKS, KNOWN), FAILED).astype(np.int8)
    units = np.where(status == KNOWN, 1.0, np.nan) * found.family.scales[0] / np.array(found.family.scales[1:])
    return Sensitivity(float(found.family.values(found.u)[0]), -adjoint @ right * units, error * units, status)


def _polished(located: Located) -> Located | None:
    """Refine a bifurcation by Newton's method; None if its steps do not become small."""
    # most steps of Newton's method, the step after which it ends, and the largest last one with which a point counts
    most_steps, close, near = 6, 1e-9, 1e-6
    n = located.n_states
    for _ in range(most_steps):
        residual = located.equations(located.u[None])[0]
        matrix, _ = located.slopes(range(n + 1))
        if not (np.isfinite(residual).all() and np.isfinite(matrix).all()):
            return None
        step = np.linalg.lstsq(matrix, -residual, rcond=None)[0]
        u = located.u.copy()
        u[: n + 1] += step
        located = replace(located, u=u)
        if np.abs(step).max() <= close:
            break
    return located if np.abs(step).max() <= near else None


def _moving(model: Model, first: str) -> list[str]:
    """Return the names of the parameters that may move a bifurcation along the first one, with the drive frequency."""
    return [name for name in axes_of(model) if name not in (first, LEVEL)]


def located_in(branches: xr.Dataset, base: Parameters) -> list[Located]:
    """Return all bifurcations of computed branches with their equations; `base` are the parameters of the run."""
    first, model = str(branches.attrs["parameter"]), base.model
    others = _moving(model, first)
    words, found = words_of(branches["kind"]) if branches.sizes["bifurcation"] else [], []
    width = float(np.ptp(branches["parameter"].values[np.isfinite(branches["parameter"].values)])) if words else 1.0
    for k, kind in enumerate(branches["kind"].values.tolist()):
        branch, value = int(branches["of_branch"][k]), float(branches["value"][k])
        fixed = {n: v for n, v in fixed_of(branches, branch).items() if n in base.names}
        own = base.replace(**fixed)
        hertz = float(branches[FREQUENCY][branch]) if FREQUENCY in branches else frequency_of(model, {})
        values = [value, *(hertz if name == FREQUENCY else own[name] for name in others)]
        scales = [min(abs(value), width) or width, *(abs(v) or 1.0 for v in values[1:])]
        period = int(branches["orbit_period"][branch])
        family = Family(model.system, period, hertz, own.pack(), (first, *others), tuple(scales))
        u = family.unknowns(branches["bifurcation_section"].values[k, 0], values)
        one = Located(family, words[kind], u, np.zeros((2, model.system.n_states)))
        matrix = one.by_state(one.closure(u[None])[1][0])
        norm = 1.0 if period else float(np.linalg.norm(matrix)) or 1.0
        left, _, right = np.linalg.svd(matrix)
        found.append(replace(one, border=np.stack([left[:, -1], right[-1]]), unit=1.0 / norm))
    return found


# ---- analysis ----------------------------------------------------------------------------------


def settle_sensitivities(run: OpenRun, options: SensitivityOptions) -> SensitivityOptions:
    """Complete the digest of the draws; raise SpecError if a deviation is of no parameter, or not above 0."""
    settle_along(run, options)
    known = [parameter_name(name) for name in _moving(run.model, axis_name(options.parameter))]
    problems = []
    for name, value in options.deviation.items():
        if parameter_name(name) not in known:
            problems.append(f"--deviation: {unknown_name('parameter', name, known)}")
        if not value > 0.0:
            problems.append(f"--deviation {name}={value:g}: must be above 0.")
    if problems:
        raise SpecError(problems)
    digest = digest_of_draws(options.posterior) if options.posterior else ""
    return options.model_copy(update={"digest": digest})


def numbered_bifurcations(run: OpenRun, options: SensitivityOptions) -> list[int]:
    """Return the numbers of the bifurcations on the branches of a run."""
    return list(range(run.derive("branches", parameter=options.parameter).sizes["bifurcation"]))


def sensitivities(run: OpenRun, options: SensitivityOptions, wanted: Sequence[int]) -> xr.Dataset:
    """Compute how some bifurcations on the branches of a run move with each parameter.

    Returns
    -------
    Dataset
        Over ``bifurcation`` and ``parameter`` (all of the model but the continued one, and the drive's ``frequency``):
        ``derivative`` of the bifurcation's value, with ``derivative_error`` [units of the continued parameter per unit
        of the parameter]; ``elasticity``, the relative change of the value over that of the parameter (NaN if one of
        them is 0), with ``elasticity_error``; ``status`` (`STATUSES`); ``parameter_value``. Over ``bifurcation``:
        ``kind``, ``value``, ``orbit_period`` and ``of_branch``. Over ``parameter``: ``unit``. `with_deviations` adds
        ``deviation`` and ``parameter_deviation``.
    """
    branches = run.derive("branches", parameter=options.parameter)
    return sensitivities_of(branches.isel(bifurcation=list(wanted)), parameters_of(run.cube()))


def with_deviations(run: OpenRun, found: xr.Dataset, options: SensitivityOptions) -> xr.Dataset:
    """Add the standard deviations of parameters, and of each bifurcation to first order, NaN without those."""
    names = _moving(run.model, axis_name(options.parameter))
    covariance = _covariance(run, options, names)
    there = np.flatnonzero(np.diag(covariance) > 0.0)
    part = found["derivative"].values[:, there]
    variance = np.einsum("ei,ij,ej->e", part, covariance[np.ix_(there, there)], part)
    about = {"units": found.attrs["parameter_units"], "long_name": "standard deviation, to first order"}
    return found.assign(
        deviation=("bifurcation", np.sqrt(variance) if len(there) else np.full(len(part), np.nan), about),
        parameter_deviation=("parameter", np.sqrt(np.diag(covariance)), {"long_name": "standard deviation"}),
    )


def sensitivities_of(branches: xr.Dataset, base: Parameters) -> xr.Dataset:
    """Return the result of `sensitivities` for computed branches of a run with given parameters."""
    first, model = str(branches.attrs["parameter"]), base.model
    located = located_in(branches, base)
    found = [sensitivity_of(one) for one in track(located, "sensitivities")]
    names = _moving(model, first)
    shape = len(found), len(names)
    value = np.array([one.value for one in found])
    derivative, error, status = (
        np.array([getattr(one, name) for one in found]).reshape(shape) for name in ("derivative", "error", "status")
    )
    at = np.array([one.family.values(one.u)[1:] for one in located]).reshape(shape)
    ratio = np.where(at != 0.0, at, np.nan) / np.where(value != 0.0, value, np.nan)[:, None]
    dims, one = ("bifurcation", "parameter"), {"units": "1"}
    sides = [name for name in ("bifurcation_side",) if name in branches]
    kept = branches[["kind", "of_branch", *sides]].drop_vars("state", errors="ignore")
    kept.attrs = {k: v for k, v in branches.attrs.items() if k != "left_out"}
    return kept.assign(
        value=("bifurcation", value, {"units": branches.attrs["parameter_units"], "long_name": f"value of {first}"}),
        orbit_period=("bifurcation", branches["orbit_period"].values[branches["of_branch"].values], one),
        derivative=(dims, derivative, {"long_name": f"derivative of {first} at the bifurcation"}),
        derivative_error=(dims, error, {"long_name": "error of the derivative"}),
        elasticity=(dims, derivative * ratio, {**one, "long_name": "relative change over that of the parameter"}),
        elasticity_error=(dims, error * np.abs(ratio), {**one, "long_name": "error of the elasticity"}),
        status=(dims, status.astype(np.int8), {**one, **code_flags(STATUSES)}),
        parameter_value=(dims, at, {"long_name": "value of the parameter"}),
        unit=("parameter", [parameter_units(name, model) for name in names]),
    ).assign_coords(parameter=names)


def _covariance(run: OpenRun, options: SensitivityOptions, names: Sequence[str]) -> Array:
    """Return the covariance of all parameters: of the draws, and of the deviations that were given."""
    found = np.zeros((len(names), len(names)))
    if options.posterior:
        draws = draws_of(run, options.posterior)
        moving = moving_of(draws, options.parameter)
        twice = sorted(set(moving) & set(options.deviation))
        if twice:
            raise SpecError(f"--deviation {twice[0]}: the posterior has its deviation; give one of both.")
        where = [names.index(name) for name in moving]
        own = draws["value"].sel(parameter=moving).transpose("parameter", "draw").values
        found[np.ix_(where, where)] = np.atleast_2d(np.cov(own))
    for name, deviation in options.deviation.items():
        i = names.index(axis_name(name))
        found[i, i] = deviation**2
    return found


def sensitivities_table(ds: xr.Dataset) -> Table:
    """Return a table with a row for each bifurcation and parameter, by falling size of the elasticity."""
    name, rows, lines = parameter_name(str(ds.attrs["parameter"])), list[Row](), list[str]()
    kinds = words_of(ds["kind"]) if ds.sizes["bifurcation"] else []
    for k in np.argsort(ds["value"].values, kind="stable"):
        one = ds.isel(bifurcation=int(k))
        kind = kinds[int(one["kind"])]
        about = {
            name: float(one["value"]),
            "label": LABELS[kind],
            "type": kind,
            "period": int(one["orbit_period"]),
            **({"side": values(one, "bifurcation_side")["bifurcation_side"]} if "bifurcation_side" in one else {}),
            "branch": int(one["of_branch"]),
            "deviation": float(one["deviation"]),
        }
        own = [{**about, **row} for row in _rows(one)]
        rows += own
        lines += ["", _head(about, name, _unit(str(ds.attrs["parameter_units"]))), *_lines(own, str(LABELS[kind]), ds)]
    head = f"{counted(ds.sizes['bifurcation'], 'bifurcation')} along {name}"
    return Table(rows, [head, *lines], header=(name, *_COLUMNS))


_COLUMNS = (
    *("label", "type", "period", "branch", "deviation", "parameter", "unit", "parameter_value", "derivative"),
    *("derivative_error", "elasticity", "elasticity_error", "parameter_deviation", "status"),
)
"""Columns that the table has in any case, after the parameter."""


def _rows(one: xr.Dataset) -> list[Row]:
    """Return the rows of a bifurcation, by falling elasticity, or derivative where there is none."""
    columns = {n: one[n].values for n in ("parameter_value", "derivative", "derivative_error")}
    columns |= {n: one[n].values for n in ("elasticity", "elasticity_error", "parameter_deviation")}
    sizes = np.nan_to_num(np.abs(one["elasticity"].values), nan=-1.0)
    order = np.lexsort((-np.nan_to_num(np.abs(one["derivative"].values)), -sizes))
    return [
        {
            "parameter": parameter_name(str(one["parameter"].values[i])),
            "unit": str(one["unit"].values[i]),
            **{n: float(v[i]) for n, v in columns.items()},
            "status": STATUSES[int(one["status"].values[i])],
        }
        for i in order
    ]


def _head(about: Mapping[str, Any], name: str, unit: str) -> str:
    what = f"period {about['period']}" if about["period"] else "equilibrium"
    spread = f" ± {about['deviation']:.2g}" if np.isfinite(about["deviation"]) else ""
    at = f"{name} {about[name]:.7g}{spread}{unit}"
    side = f", {about['side']}" if "side" in about else ""
    return f"{about['label']} {plain(about['type'])} at {at}, {what}{side}, branch {about['branch']}"


def _unit(unit: str) -> str:
    return "" if unit in ("", "1") else f" {unit}"


def _lines(rows: Sequence[Row], label: str, ds: xr.Dataset) -> list[str]:
    shown, idle, unit = list[Words](), list[str](), _unit(str(ds.attrs["parameter_units"]))
    for row in rows:
        size = abs(row["elasticity"]) if np.isfinite(row["elasticity"]) else abs(row["derivative"])
        if row["status"] == "known" and size <= max(NO_INFLUENCE, row["elasticity_error"]):
            idle.append(row["parameter"])
            continue
        known, deviation = row["status"] == "known", row["parameter_deviation"]
        shown.append(
            {
                "1 % more": row["parameter"],
                f"moves this {label} by": _percent(row) if known else _WHY[row["status"]],
                "derivative": f"{row['derivative']:+.6g}{unit}{_per(row['unit'])}" if known else "",
                "error": f"{row['derivative_error']:.0e}" if known else "",
                "by one deviation": f"{row['derivative'] * deviation:+.3g}{unit}" if deviation > 0.0 else None,
            }
        )
    return [*aligned(shown), *([f"  without influence: {', '.join(idle)}"] if idle else [])]


def _per(unit: str) -> str:
    return "" if unit in ("", "1") else f" per ({unit})" if "/" in unit else f" per {unit}"


_WHY = {"breaks": "it does not survive", "failed": "not decided"}


def _percent(row: Row) -> str:
    """Return the move for 1 % more of a parameter, with as many digits as its error allows."""
    if not np.isfinite(row["elasticity"]):
        return "-"
    if not abs(row["elasticity"]) > row["elasticity_error"]:
        return "?"
    digits = int(np.clip(np.floor(np.log10(abs(row["elasticity"]) / max(row["elasticity_error"], 1e-300))), 1, 4))
    return f"{row['elasticity']:+.{digits}g} %"
