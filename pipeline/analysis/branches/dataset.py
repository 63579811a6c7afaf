"""Convert branches of periodic orbits into a labelled dataset, with the side and the rotation of each orbit."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.models.model import Classifier, Model, Parameters
from magpend_core.models.sectioned import of_flow
from magpend_core.orbits import on_section
from magpend_core.sampling import Drive, sample
from magpend_core.sections import run_branches
from pipeline.analysis.branches.bifurcations import (
    CONTRADICTORY,
    Bifurcation,
    counts_of,
    eigenvalues_of,
    multipliers_of,
)
from pipeline.analysis.branches.following import ENDS, Branch, Limit
from pipeline.analysis.branches.kinds import HOPF, KINDS
from pipeline.analysis.branches.problems import FREQUENCY, parameter_units, state_units
from pipeline.analysis.branches.stuck import stuck_ends
from pipeline.analysis.tolerances import BRANCH_RTOL
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import model_attribute, period_of, periods_of, section_attributes
from pipeline.products.reporting import track

CRITICALITIES = ("", "supercritical", "subcritical", CONTRADICTORY)


SAMPLES = 64
"""Instants per drive period or return at which the side of an orbit is judged."""


def dataset_of(
    branches: Sequence[Branch], parameter: str, parameters: Parameters | None = None, left_out: Sequence[str] = ()
) -> xr.Dataset:
    """Return branches as a labelled dataset; `pipeline.analysis.branches` lists its variables.

    Parameters
    ----------
    branches
        Result of `exploring.explore`; may be empty.
    parameter
        Name of the free parameter, ``frequency`` for the drive frequency.
    parameters
        Parameters of the run; their model gives names, units, and the class of each orbit's motion.
    left_out
        Lines on attractors that were not followed, with reasons.
    """
    model = None if parameters is None else parameters.model
    system = branches[0].family.system if branches else (None if model is None else model.system)
    names = () if system is None else system.state_names
    n_angles = 0 if system is None else sum(system.is_angle)
    longest = max([1, *(b.family.period for b in branches)])
    shape = (len(branches), max((len(b.points) for b in branches), default=0))
    arrays = _Arrays(shape, longest, len(names))
    for i, branch in enumerate(branches):
        for j, point in enumerate(branch.points):
            arrays.put(i, j, branch, point)
        arrays.n_unstable[i, : len(branch.points)] = counts_of(branch.points, branch.bifurcations)
    words = model.classifier.words if model is not None and model.classifier is not None else ()
    if parameters is not None and words:
        for i, codes in enumerate(sides_of(branches, parameters)):
            arrays.side[i, : len(codes)] = codes
    events = [(i, b) for i, branch in enumerate(branches) for b in branch.bifurcations]
    states = state_units(model)
    variables = arrays.variables(parameter_units(parameter, model), states)
    variables |= _per_branch(branches, events, n_angles, model) | _per_event(branches, events, longest, names, states)
    for name in ("value", "bracket"):
        variables[name][2]["units"] = parameter_units(parameter, model)
    variables |= _fixed(branches, parameter, parameters)
    variables |= _limits(branches, parameter_units(parameter, model), states)
    if words:
        variables |= _side_variables(arrays.side, events, words)
    angle_dim = "angle" if model is None else model.angle_dim
    result = xr.Dataset(variables).rename({"angle": angle_dim} if angle_dim != "angle" else {})
    result = result.assign_coords(state=("state", list(names), {"long_name": "component of the state"}))
    if model is not None:
        result = result.assign_coords({angle_dim: list(model.angles)}).assign_attrs(
            model=model_attribute(model), **section_attributes(model.crossing)
        )
    return result.assign_attrs(
        parameter=parameter,
        parameter_units=parameter_units(parameter, model),
        left_out="\n".join(left_out),
        stuck="\n".join(stuck_ends(branches)),
    )


def _limits(branches: Sequence[Branch], units: str, states: str) -> dict[str, Any]:
    """Return dataset variables for the ends at which periods grow without bound; none if there is no such end."""
    found = [(i, end, one) for i, b in enumerate(branches) for end, one in enumerate(b.limits) if one is not None]
    if not found:
        return {}
    n, dims = branches[0].family.system.n_states, ("branch", "end")

    def laid(about: str, unit: str, get: Callable[[Limit], Any], *dim: str) -> tuple[tuple[str, ...], Any, Any]:
        values = np.full((len(branches), 2, *([n] if dim else [])), np.nan)
        for i, end, one in found:
            values[i, end] = get(one)
        return ((*dims, *dim), values, {"units": unit, "long_name": about})

    per_root = "s, or s times the root of the parameter's unit"
    slope = "slope of the period over -ln|p - p_h|, or over 1/sqrt|p - p_h| at a saddle node on a circle"
    at = "equilibrium where the period is infinite"
    return {
        "limit_value": laid("parameter value where the period is infinite", units, lambda one: one.value),
        "limit_error": laid("error of this value", units, lambda one: one.error),
        "limit_state": laid(at, states, lambda one: one.state, "state"),
        "limit_eigenvalue_real": laid(f"eigenvalues of the {at}, real part", "1/s", _real, "multiplier"),
        "limit_eigenvalue_imag": laid(f"eigenvalues of the {at}, imaginary part", "1/s", _imag, "multiplier"),
        "limit_slope": laid(f"{slope}: fitted", per_root, lambda one: one.slope),
        "limit_slope_error": laid("error of the fitted slope", per_root, lambda one: one.slope_error),
        "limit_slope_expected": laid("the same slope, from the equilibrium", per_root, lambda one: one.expected),
    }


def _real(one: Limit) -> np.ndarray:
    return np.asarray(one.eigenvalues.real)


def _imag(one: Limit) -> np.ndarray:
    return np.asarray(one.eigenvalues.imag)


def _fixed(branches: Sequence[Branch], parameter: str, parameters: Parameters | None) -> dict[str, Any]:
    """Return dataset variables for the fixed parameters whose values differ between the branches and the run."""
    if parameters is None or not branches:
        return {}
    values = np.array([b.family.parameters for b in branches])
    own = (values != parameters.pack()).any(axis=0)
    chosen = [i for i, n in enumerate(parameters.names) if n != parameter and own[i]]
    names = [parameters.names[i] for i in chosen]
    units = [parameter_units(n, parameters.model) for n in names]
    return {
        n: ("branch", values[:, i], {"units": u, "long_name": f"value of {n}"})
        for n, i, u in zip(names, chosen, units, strict=True)
    }


def _side_variables(
    side: np.ndarray, events: Sequence[tuple[int, Bifurcation]], words: Sequence[str]
) -> dict[str, Any]:
    about = {"units": "1", **code_flags(words)}
    there = np.array([side[i, max(b.after, 0)] for i, b in events], np.int8)
    return {
        "side": (("branch", "point"), side, {**about, "long_name": "class of the whole orbit"}),
        "bifurcation_side": ("bifurcation", there, {**about, "long_name": "class of the orbit there"}),
    }


class _Arrays:
    """Arrays of the output variables, with one entry per branch and branch point."""

    def __init__(self, shape: tuple[int, int], longest: int, n_states: int) -> None:
        self.parameter = np.full(shape, np.nan)
        self.section = np.full((*shape, longest, n_states), np.nan)
        self.multiplier = np.full((*shape, n_states), np.nan, np.complex128)
        self.eigenvalue = np.full((*shape, n_states), np.nan, np.complex128)
        self.n_unstable = np.full(shape, -1, np.int8)
        self.side = np.zeros(shape, np.int8)
        self.residual = np.full(shape, np.nan)
        self.period_s = np.full(shape, np.nan)

    def put(self, i: int, j: int, branch: Branch, point: Any) -> None:
        self.parameter[i, j] = branch.family.values(point.u)[0]
        self.section[i, j, : max(branch.family.period, 1)] = _orbit(branch, point)
        self.multiplier[i, j] = multipliers_of(point)
        self.eigenvalue[i, j] = eigenvalues_of(point)
        self.residual[i, j] = point.residual
        self.period_s[i, j] = point.value.seconds

    def variables(self, units: str, state_units: str) -> dict[str, Any]:
        """Return the output arrays as (dims, values, attributes), from which xarray builds a Dataset; `units` is the
        parameter's unit.
        """
        dims = ("branch", "point")
        return self._eigenvalues() | {
            "parameter": (dims, self.parameter, {"units": units, "long_name": "value of the parameter"}),
            "section": (
                (*dims, "phase", "state"),
                self.section,
                {"units": state_units, "long_name": "section points of the orbit"},
            ),
            "multiplier_real": (
                (*dims, "multiplier"),
                self.multiplier.real,
                {"units": "1", "long_name": "Floquet multipliers, real part"},
            ),
            "multiplier_imag": (
                (*dims, "multiplier"),
                self.multiplier.imag,
                {"units": "1", "long_name": "Floquet multipliers, imaginary part"},
            ),
            "n_unstable": (
                dims,
                self.n_unstable,
                {"units": "1", "long_name": "multipliers outside the unit circle, -1 beyond the branch"},
            ),
            "residual": (
                dims,
                self.residual,
                {"units": "1", "long_name": "scaled distance of the point from its image"},
            ),
            "period_s": (dims, self.period_s, {"units": "s", "long_name": "period of the orbit"}),
        }

    def _eigenvalues(self) -> dict[str, Any]:
        if np.isnan(self.eigenvalue).all():
            return {}
        dims, about = ("branch", "point", "multiplier"), "eigenvalues of an equilibrium"
        return {
            "eigenvalue_real": (dims, self.eigenvalue.real, {"units": "1/s", "long_name": f"{about}, real part"}),
            "eigenvalue_imag": (dims, self.eigenvalue.imag, {"units": "1/s", "long_name": f"{about}, imaginary part"}),
        }


def _orbit(branch: Branch, point: Any) -> np.ndarray:
    """Return the section points (period, state) of an orbit from the given point on; for an equilibrium its state."""
    images = np.asarray(point.value.images)
    return np.concatenate([branch.family.state(point.u)[None], images[: max(branch.family.period, 1) - 1]])


def _column(values: Any, dtype: str, long_name: str, **attrs: Any) -> tuple[np.ndarray, dict[str, Any]]:
    return np.asarray(values, dtype), {"units": "1", "long_name": long_name, **attrs}


def _per_branch(
    branches: Sequence[Branch], events: Sequence[tuple[int, Bifurcation]], n_angles: int, model: Model | None
) -> dict[str, Any]:
    numbers = {id(b): k for k, (_, b) in enumerate(events)}
    periods = [b.family.period for b in branches]
    frequencies = [np.nan if FREQUENCY in b.family.free else b.family.frequency_hz for b in branches]
    first, last = ([ENDS.index(b.ends[i]) for b in branches] for i in (0, 1))
    columns = {
        "orbit_period": _column(periods, "int32", f"period in {periods_of(model)}, 0 for equilibria"),
        "n_points": _column([len(b.points) for b in branches], "int32", "points of the branch"),
        "origin": _column(
            [numbers.get(id(b.origin), -1) for b in branches], "int32", "bifurcation it sprang from, -1 none"
        ),
        "first_end": _column(first, "int8", "why it begins", **code_flags(ENDS)),
        "last_end": _column(last, "int8", "why it ends", **code_flags(ENDS)),
    }
    if model is None or model.clock_hz is None:
        about = "drive frequency, NaN if it varies"
        columns[FREQUENCY] = _column(frequencies, "float64", about, units="Hz")
    found: dict[str, Any] = {name: ("branch", *column) for name, column in columns.items()}
    turns = np.array([rotation_of(b) for b in branches]).reshape(len(branches), n_angles)
    found["rotation"] = (("branch", "angle"), *_column(turns, "float64", f"turns per {period_of(model)}"))
    return found


def _seconds(one: Bifurcation) -> float:
    """Return the period of the orbit at a bifurcation [s]; at a Hopf point it is the period of the limit cycles that
    start there.
    """
    if one.kind == HOPF:
        return 2.0 * np.pi / one.critical_multiplier.imag
    return one.point.value.seconds


def _per_event(
    branches: Sequence[Branch],
    events: Sequence[tuple[int, Bifurcation]],
    longest: int,
    names: Sequence[str],
    units: str,
) -> dict[str, Any]:
    ones = [b for _, b in events]
    critical = np.array([b.critical_multiplier for b in ones], np.complex128)
    multipliers = np.array([multipliers_of(b.point) for b in ones], np.complex128)
    multipliers = multipliers.reshape(len(ones), len(names))
    section = np.full((len(events), longest, len(names)), np.nan)
    for k, (i, b) in enumerate(events):
        section[k, : max(branches[i].family.period, 1)] = _orbit(branches[i], b.point)
    numbers = {id(b): i for i, b in enumerate(branches)}
    kinds, degrees = [KINDS.index(b.kind) for b in ones], [CRITICALITIES.index(b.criticality) for b in ones]
    values = [branches[i].family.values(b.point.u)[0] for i, b in events]
    children = [numbers.get(id(b.child), -1) for b in ones]
    columns = {
        "kind": _column(kinds, "int8", "kind of bifurcation", **code_flags(KINDS)),
        "value": _column(values, "float64", "parameter value of the bifurcation"),
        "bifurcation_period_s": _column(
            [_seconds(b) for b in ones], "float64", "period of the orbit, or of a Hopf point's cycles", units="s"
        ),
        "bracket": _column([b.bracket for b in ones], "float64", "width of the bracket in the parameter"),
        "of_branch": _column([i for i, _ in events], "int32", "branch on which it lies"),
        "after": _column([b.after for b in ones], "int32", "point of the branch that it comes after"),
        "to_branch": _column(children, "int32", "other branch through it, -1 none"),
        "n_unstable_before": _column(
            [b.n_unstable_before for b in ones], "int8", "unstable multipliers before, along the branch"
        ),
        "n_unstable_after": _column(
            [b.n_unstable_after for b in ones], "int8", "unstable multipliers after, along the branch"
        ),
        "rises_before": _column(
            [b.rises_before for b in ones], "int8", "1 if the parameter rises along the branch before"
        ),
        "criticality": _column(degrees, "int8", "criticality", **code_flags(["unknown", *CRITICALITIES[1:]])),
        "critical_real": _column(critical.real, "float64", "critical multiplier or eigenvalue [1/s], real part"),
        "critical_imag": _column(critical.imag, "float64", "critical multiplier or eigenvalue [1/s], imaginary part"),
        "normal_form": _column(
            [b.coefficient for b in ones], "float64", "normal form coefficient; of a Hopf point in 1/s"
        ),
        "normal_form_error": _column([b.coefficient_error for b in ones], "float64", "error of the coefficient"),
    }
    found: dict[str, Any] = {name: ("bifurcation", *column) for name, column in columns.items()}
    dims = ("bifurcation", "multiplier")
    found["bifurcation_multiplier_real"] = (dims, *_column(multipliers.real, "float64", "multipliers, real"))
    found["bifurcation_multiplier_imag"] = (dims, *_column(multipliers.imag, "float64", "multipliers, imaginary"))
    found["bifurcation_section"] = (
        ("bifurcation", "phase", "state"),
        *_column(section, "float64", "section points of the orbit there", units=units),
    )
    return found


def sides_of(branches: Sequence[Branch], base: Parameters) -> list[np.ndarray]:
    """Return the class of motion (a code) of each orbit of each branch, by the model's classifier.

    Parameters
    ----------
    branches
        Branches of a model with a classifier.
    base
        Parameters of the run; each branch replaces those in which it differs.
    """
    classifier = base.model.classifier
    assert classifier is not None
    return [_sides(branch, base, classifier) for branch in track(branches, "telling sides")]


def _sides(branch: Branch, base: Parameters, classifier: Classifier) -> np.ndarray:
    family = branch.family
    if not family.period or base.model.is_map:
        return _point_sides(branch, base, classifier)
    own = base.replace(**dict(zip(base.names, map(float, family.parameters), strict=True)))
    name, flow = family.free[0], of_flow(own).model.system
    angles = np.flatnonzero(family.system.is_angle)
    n_samples = family.period * SAMPLES
    parameters, times, drives = [], [], []
    for point in branch.points:
        value = float(family.values(point.u)[0])
        frequency = value if name == FREQUENCY else family.frequency_hz
        parameters.append(own if name == FREQUENCY else own.replace(**{name: value}))
        if base.model.crossing is not None:
            frequency = family.period / point.value.seconds
        times.append(np.arange(n_samples + 1) / (SAMPLES * frequency))
        drives.append(Drive(np.full(family.period, 1.0 / frequency)))
    packed = np.array([of_flow(one).pack() for one in parameters])
    starts = np.array([family.state(point.u) for point in branch.points])
    found = sample(flow, packed, starts, times, drives=drives, limits_first_step=False).states
    turns = np.round((found[:, -1, angles] - found[:, 0, angles]) / (2.0 * np.pi)).astype(np.int64)
    codes = [
        classifier.classify(states, n, _SEEN_WHOLE, _values(one))
        for states, n, one in zip(found, turns, parameters, strict=True)
    ]
    return np.array(codes, np.int8)


def _point_sides(branch: Branch, base: Parameters, classifier: Classifier) -> np.ndarray:
    """Return the classes of motion of equilibria, and of orbits of a map, from their points alone."""
    name, n_angles = branch.family.free[0], sum(branch.family.system.is_angle)
    own = base.replace(**dict(zip(base.names, map(float, branch.family.parameters), strict=True)))
    codes = []
    for point in branch.points:
        values = own.replace(**{name: float(branch.family.values(point.u)[0])})
        own_points = point.value.images if branch.family.period else branch.family.state(point.u)[None]
        states = np.repeat(own_points, 2, axis=0)
        codes.append(classifier.classify(states, np.zeros(n_angles, np.int64), _SEEN_WHOLE, _values(values)))
    return np.array(codes, np.int8)


_SEEN_WHOLE = np.array(np.inf)
"""Frequency given to the classifier: infinite, since samples of the whole orbit leave no gap."""


def _values(parameters: Parameters) -> Mapping[str, Any]:
    return parameters.as_dict()


def rotation_of(branch: Branch) -> np.ndarray:
    """Compute how often each angle turns per drive period or return to the section, on the first orbit of a branch."""
    family = branch.family
    if not any(family.system.is_angle) or not family.period:
        return np.zeros(sum(family.system.is_angle))
    rows = family.rows(branch.points[0].u[None])
    result = run_branches(
        rows.parameters[:, None],
        rows.frequency_hz[:, None],
        on_section(rows.states, rows.parameters, family.system),
        n_transient=0,
        n_keep=family.period + 1,
        rtol=BRANCH_RTOL,
        atol=BRANCH_RTOL,
        system=family.system,
    )
    return np.asarray(result.turns[0, 0] / family.period, np.float64)
