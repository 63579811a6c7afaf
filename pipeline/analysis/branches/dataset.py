"""Convert branches of periodic orbits into a labelled dataset, with the side and the rotation of each orbit."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.models.model import Classifier, Model, Parameters
from magpend_core.models.sectioned import of_flow
from magpend_core.orbits import on_section
from magpend_core.precision import limits_at
from magpend_core.sampling import Drive, sample
from magpend_core.sections import run_branches
from pipeline.analysis.branches.bifurcations import (
    CONTRADICTORY,
    Bifurcation,
    counts_of,
    eigenvalues_of,
    multipliers_of,
)
from pipeline.analysis.branches.declaration import BRANCH_COLUMNS
from pipeline.analysis.branches.following import ENDS, Branch
from pipeline.analysis.branches.images import images_of
from pipeline.analysis.branches.kinds import HOPF, KINDS
from pipeline.analysis.branches.limits import cut_ends
from pipeline.analysis.branches.problems import FREQUENCY
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import model_attribute, parameter_name, parameter_units, section_attributes
from pipeline.products.reporting import track
from pipeline.results.tolerances import BRANCH_RTOL

CRITICALITIES = ("", "supercritical", "subcritical", CONTRADICTORY)


def dataset_of(
    branches: Sequence[Branch],
    parameter: str,
    parameters: Parameters | None = None,
    left_out: Sequence[str] = (),
    word: str = parameter_name(FREQUENCY),
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
        Lines on attractors that were not followed, with reasons; those on the ends of branches are added.
    word
        Word for the drive's rate in the added lines.
    """
    model = None if parameters is None else parameters.model
    system = branches[0].family.system if branches else (None if model is None else model.system)
    names = () if system is None else system.state_names
    n_angles = 0 if system is None else sum(system.is_angle)
    longest = max([1, *(b.family.period for b in branches)])
    points = [((i, j), (b, point)) for i, b in enumerate(branches) for j, point in enumerate(b.points)]
    shape = (len(branches), max((len(b.points) for b in branches), default=0))
    counts, side = np.full(shape, -1, np.int8), np.zeros(shape, np.int8)
    for i, branch in enumerate(branches):
        counts[i, : len(branch.points)] = counts_of(branch.points, branch.bifurcations)
    words = model.classifier.words if model is not None and model.classifier is not None else ()
    if parameters is not None and words:
        for i, codes in enumerate(sides_of(branches, parameters)):
            side[i, : len(codes)] = codes
    events = [(i, b) for i, branch in enumerate(branches) for b in branch.bifurcations]
    sizes = {"phase": longest, "state": len(names), "multiplier": len(names)}
    variables = _per_point(shape, points, sizes)
    variables["n_unstable"] = (("branch", "point"), counts)
    variables |= _per_branch(branches, events, n_angles, model) | _per_event(branches, events, sizes)
    variables |= _limits(branches, sizes)
    if model is not None and model.flow.mirror is not None:
        images = images_of([(branches[i].family, b) for i, b in events], model)
        variables["image"] = ("bifurcation", *column(images, "int32"))
    if words:
        variables |= _side_variables(side, events, words)
    angle_dim = "angle" if model is None else model.angle_dim
    result = xr.Dataset(variables).rename({"angle": angle_dim} if angle_dim != "angle" else {})
    result = result.assign_coords(state=list(names), **_fixed(branches, parameter, parameters))
    if model is not None:
        result = result.assign_coords({angle_dim: list(model.angles)}).assign_attrs(
            model=model_attribute(model), **section_attributes(model.crossing)
        )
    return result.assign_attrs(
        parameter=parameter,
        parameter_units=parameter_units(parameter, model),
        left_out="\n".join([*left_out, *cut_ends(branches, word)]),
    )


Columns = Mapping[str, tuple[tuple[str, ...], Callable[..., Any]]]
"""Variables by name: further dims, and the function that returns the values of one item."""


def filled(
    dims: tuple[str, ...],
    shape: tuple[int, ...],
    items: Sequence[tuple[tuple[int, ...], tuple[Any, ...]]],
    sizes: Mapping[str, int],
    columns: Columns,
) -> dict[str, Any]:
    """Return dataset variables with the values of some items at their indices, and NaN elsewhere."""
    found = {}
    for name, (further, values_of) in columns.items():
        values = np.full((*shape, *(sizes[dim] for dim in further)), np.nan)
        for index, item in items:
            own = np.asarray(values_of(*item))
            place: tuple[Any, ...] = (*index, *(slice(n) for n in own.shape))
            values[place] = own
        found[name] = ((*dims, *further), values)
    return found


def _parts(name: str, values_of: Callable[..., Any]) -> Columns:
    """Return the columns of the real and imaginary parts of multipliers or eigenvalues."""
    return {
        f"{name}_real": (("multiplier",), lambda *item: values_of(*item).real),
        f"{name}_imag": (("multiplier",), lambda *item: values_of(*item).imag),
    }


def _per_point(shape: tuple[int, ...], points: Sequence[Any], sizes: Mapping[str, int]) -> dict[str, Any]:
    """Return dataset variables for the points of all branches."""
    columns: Columns = {
        "parameter": ((), lambda b, point: b.family.values(point.u)[0]),
        "section": (("phase", "state"), _orbit),
        **_parts("multiplier", lambda _, point: multipliers_of(point)),
        "residual": ((), lambda _, point: point.residual),
        "period_s": ((), lambda _, point: point.value.seconds),
    }
    if any(point.value.is_rest for _, (_, point) in points):
        own = _parts("eigenvalue", lambda _, point: eigenvalues_of(point))
        columns = {**own, **columns}
    return filled(("branch", "point"), shape, points, sizes, columns)


def _limits(branches: Sequence[Branch], sizes: Mapping[str, int]) -> dict[str, Any]:
    """Return dataset variables for the ends at which periods grow without bound; none if there is no such end."""
    found = [((i, end), (one,)) for i, b in enumerate(branches) for end, one in enumerate(b.limits) if one is not None]
    sizes = {**sizes, "rest": max((len(one.states) for _, (one,) in found), default=0)}
    columns: Columns = {
        "limit_value": ((), lambda one: one.value),
        "limit_error": ((), lambda one: one.error),
        "limit_state": (("rest", "state"), lambda one: one.states),
        **_parts("limit_eigenvalue", lambda one: one.eigenvalues),
        "limit_slope": ((), lambda one: one.slope),
        "limit_slope_error": ((), lambda one: one.slope_error),
        "limit_slope_expected": ((), lambda one: one.expected),
    }
    return filled(("branch", "end"), (len(branches), 2), found, sizes, columns) if found else {}


def _fixed(branches: Sequence[Branch], parameter: str, parameters: Parameters | None) -> dict[str, Any]:
    """Return coordinates with the fixed parameters whose values differ between the branches and the run."""
    if parameters is None or not branches:
        return {}
    values = np.array([b.family.parameters for b in branches])
    own = (values != parameters.pack()).any(axis=0)
    chosen = [i for i, n in enumerate(parameters.names) if n != parameter and own[i]]
    names = [parameters.names[i] for i in chosen]
    units = [parameter_units(n, parameters.model) for n in names]
    taken = {*(one.name for one in BRANCH_COLUMNS), *" ".join(one.dims for one in BRANCH_COLUMNS).split()}
    return {
        f"parameter_{n}" if n in taken else n: ("branch", values[:, i], {"units": u, "long_name": f"value of {n}"})
        for n, i, u in zip(names, chosen, units, strict=True)
    }


def _side_variables(
    side: np.ndarray, events: Sequence[tuple[int, Bifurcation]], words: Sequence[str]
) -> dict[str, Any]:
    about = code_flags(words)
    there = np.array([side[i, max(b.after, 0)] for i, b in events], np.int8)
    return {"side": (("branch", "point"), side, about), "bifurcation_side": ("bifurcation", there, about)}


def _orbit(branch: Branch, point: Any) -> np.ndarray:
    """Return the section points (period, state) of an orbit from the given point on; for an equilibrium its state."""
    images = np.asarray(point.value.images)
    return np.concatenate([branch.family.state(point.u)[None], images[: max(branch.family.period, 1) - 1]])


def column(values: Any, dtype: str, **attrs: Any) -> tuple[np.ndarray, dict[str, Any]]:
    """Return values of a type with their attributes, for a variable of one dim."""
    return np.asarray(values, dtype), attrs


def _per_branch(
    branches: Sequence[Branch], events: Sequence[tuple[int, Bifurcation]], n_angles: int, model: Model | None
) -> dict[str, Any]:
    numbers = {id(b): k for k, (_, b) in enumerate(events)}
    periods = [b.family.period for b in branches]
    frequencies = [np.nan if FREQUENCY in b.family.free else b.family.frequency_hz for b in branches]
    first, last = ([ENDS.index(b.ends[i]) for b in branches] for i in (0, 1))
    columns = {
        "orbit_period": column(periods, "int32"),
        "n_points": column([len(b.points) for b in branches], "int32"),
        "origin": column([numbers.get(id(b.origin), -1) for b in branches], "int32"),
        "first_end": column(first, "int8", **code_flags(ENDS)),
        "last_end": column(last, "int8", **code_flags(ENDS)),
    }
    if (model is None or model.clock.hertz is None) and not np.isnan(frequencies).all():
        columns[FREQUENCY] = column(frequencies, "float64")
    found: dict[str, Any] = {name: ("branch", *column) for name, column in columns.items()}
    turns = np.array([rotation_of(b) for b in branches]).reshape(len(branches), n_angles)
    found["rotation"] = (("branch", "angle"), *column(turns, "float64"))
    return found


def _seconds(one: Bifurcation) -> float:
    """Return the period of the orbit at a bifurcation [s]; at a Hopf point it is the period of the limit cycles that
    start there.
    """
    if one.kind == HOPF:
        return 2.0 * np.pi / one.critical_multiplier.imag
    return one.point.value.seconds


def _per_event(
    branches: Sequence[Branch], events: Sequence[tuple[int, Bifurcation]], sizes: Mapping[str, int]
) -> dict[str, Any]:
    ones = [b for _, b in events]
    critical = np.array([b.critical_multiplier for b in ones], np.complex128)
    numbers = {id(b): i for i, b in enumerate(branches)}
    kinds, degrees = [KINDS.index(b.kind) for b in ones], [CRITICALITIES.index(b.criticality) for b in ones]
    values = [branches[i].family.values(b.point.u)[0] for i, b in events]
    children = [numbers.get(id(b.child), -1) for b in ones]
    columns = {
        "kind": column(kinds, "int8", **code_flags(KINDS)),
        "value": column(values, "float64"),
        "bifurcation_period_s": column([_seconds(b) for b in ones], "float64"),
        "bracket": column([b.bracket for b in ones], "float64"),
        "of_branch": column([i for i, _ in events], "int32"),
        "after": column([b.after for b in ones], "int32"),
        "to_branch": column(children, "int32"),
        "n_unstable_before": column([b.n_unstable_before for b in ones], "int8"),
        "n_unstable_after": column([b.n_unstable_after for b in ones], "int8"),
        "rises_before": column([b.rises_before for b in ones], "int8"),
        "criticality": column(degrees, "int8", **code_flags(["unknown", *CRITICALITIES[1:]])),
        "critical_real": column(critical.real, "float64"),
        "critical_imag": column(critical.imag, "float64"),
        "normal_form": column([b.coefficient for b in ones], "float64"),
        "normal_form_error": column([b.coefficient_error for b in ones], "float64"),
    }
    found: dict[str, Any] = {name: ("bifurcation", *column) for name, column in columns.items()}
    items = [((k,), (branches[i], b.point)) for k, (i, b) in enumerate(events)]
    further: Columns = {
        **_parts("bifurcation_multiplier", lambda _, point: multipliers_of(point)),
        "bifurcation_section": (("phase", "state"), _orbit),
    }
    return found | filled(("bifurcation",), (len(events),), items, sizes, further)


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
    per_return = 64  # instants per drive period or return at which the side of an orbit is judged
    family = branch.family
    if not family.period or not base.model.clock.is_continuous:
        return _point_sides(branch, base, classifier)
    own = base.replace(**dict(zip(base.names, map(float, family.parameters), strict=True)))
    name, flow = family.free[0], of_flow(own).model.system
    angles = np.flatnonzero(family.system.is_angle)
    n_samples = family.period * per_return
    parameters, times, drives = [], [], []
    for point in branch.points:
        value = float(family.values(point.u)[0])
        frequency = value if name == FREQUENCY else family.frequency_hz
        parameters.append(own if name == FREQUENCY else own.replace(**{name: value}))
        if base.model.crossing is not None:
            frequency = family.period / point.value.seconds
        times.append(np.arange(n_samples + 1) / (per_return * frequency))
        drives.append(Drive(np.full(family.period, 1.0 / frequency)))
    packed = np.array([of_flow(one).pack() for one in parameters])
    starts = np.array([family.state(point.u) for point in branch.points])
    found = sample(flow, packed, starts, times, drives=drives, limits_first_step=False).states
    turns = np.round((found[:, -1, angles] - found[:, 0, angles]) / (2.0 * np.pi)).astype(np.int64)
    codes = [
        classifier.classify(states, n, _SEEN_WHOLE, one.as_dict())
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
        codes.append(classifier.classify(states, np.zeros(n_angles, np.int64), _SEEN_WHOLE, values.as_dict()))
    return np.array(codes, np.int8)


_SEEN_WHOLE = np.array(np.inf)
"""Frequency given to the classifier: infinite, since samples of the whole orbit leave no gap."""


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
        **limits_at(BRANCH_RTOL),
        system=family.system,
    )
    return np.asarray(result.turns[0, 0] / family.period, np.float64)
