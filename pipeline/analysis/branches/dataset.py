"""Branches as a labelled dataset, and the tables drawn from it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.engine.variational import with_tangents
from magpend_core.models.parameters import Parameters
from magpend_core.sections import run_branches
from magpend_core.trajectory import trajectory
from pipeline.analysis.branches.bifurcations import FOLD, KINDS, Bifurcation, multipliers_of, n_unstable
from pipeline.analysis.branches.following import ENDS, Branch
from pipeline.analysis.branches.problems import FREQUENCY, RTOL
from pipeline.analysis.branches.units import STATE_UNITS, units_of
from pipeline.analysis.sides import ARM_LENGTHS, Side

CRITICALITIES = ("", "supercritical", "subcritical")
SAMPLES = 64
"""Instants per drive period at which the side of an orbit is judged."""


def dataset_of(branches: Sequence[Branch], parameter: str, parameters: Parameters | None) -> xr.Dataset:
    """Return branches as a dataset; see `pipeline.analysis.branches` for its variables.

    Parameters
    ----------
    branches
        From `exploring.explore`.
    parameter
        Name of the free parameter.
    parameters
        What was integrated, if it is the pendulum: tells the orbits' sides.
    """
    n_states = branches[0].family.system.n_states if branches else 4
    names = branches[0].family.system.state_names if branches else ("psi1", "psi2", "psi1_dot", "psi2_dot")
    longest = max((b.family.period for b in branches), default=1)
    shape = (len(branches), max((len(b.points) for b in branches), default=0))
    arrays = _Arrays(shape, longest, n_states)
    for i, branch in enumerate(branches):
        for j, point in enumerate(branch.points):
            arrays.put(i, j, branch, point)
        _settle_origin(arrays.n_unstable[i], branch)
        if parameters is not None:
            arrays.side[i, : len(branch.points)] = _sides(branch, parameters)
    events = [(i, b) for i, branch in enumerate(branches) for b in branch.bifurcations]
    per_branch = _per_branch(branches, events)
    per_event = _per_event(branches, events, longest, n_states, arrays)
    result = xr.Dataset({**arrays.variables(units_of(parameter)), **per_branch, **per_event})
    result = result.assign_coords(state=("state", list(names), {"long_name": "component of the state"}))
    return result.assign_attrs(parameter=parameter, parameter_units=units_of(parameter))


def _settle_origin(counts: np.ndarray, branch: Branch) -> None:
    """Count at the point where a branch sprang off, with a multiplier on the circle, as at the next one."""
    for j, point in enumerate(branch.points):
        if branch.origin is not None and point.u is branch.origin.point.u:
            counts[j] = counts[j + 1] if j + 1 < len(branch.points) else counts[j - 1]


class _Arrays:
    """Variables per point of a branch."""

    def __init__(self, shape: tuple[int, int], longest: int, n_states: int) -> None:
        self.parameter = np.full(shape, np.nan)
        self.section = np.full((*shape, longest, n_states), np.nan)
        self.multiplier = np.full((*shape, n_states), np.nan, np.complex128)
        self.n_unstable = np.full(shape, -1, np.int8)
        self.side = np.full(shape, int(Side.UNKNOWN), np.int8)
        self.residual = np.full(shape, np.nan)

    def put(self, i: int, j: int, branch: Branch, point: Any) -> None:
        """Write point number `j` of branch number `i`."""
        self.parameter[i, j] = branch.family.values(point.u)[0]
        self.section[i, j, : branch.family.period] = _orbit(branch, point)
        self.multiplier[i, j] = multipliers_of(point)
        self.n_unstable[i, j] = n_unstable(point)
        self.residual[i, j] = point.residual

    def variables(self, units: str) -> dict[str, Any]:
        """As xarray takes them; `units` are those of the parameter."""
        dims = ("branch", "point")
        return {
            "parameter": (dims, self.parameter, {"units": units, "long_name": "value of the parameter"}),
            "section": (
                (*dims, "phase", "state"),
                self.section,
                {"units": STATE_UNITS, "long_name": "section points of the orbit"},
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
            "side": (
                dims,
                self.side,
                {"units": "1", "long_name": "side of the whole orbit", **_side_flags()},
            ),
            "residual": (
                dims,
                self.residual,
                {"units": "1", "long_name": "scaled distance of the point from its image"},
            ),
        }


def _orbit(branch: Branch, point: Any) -> np.ndarray:
    """Section points of an orbit, the point itself first."""
    images = np.asarray(point.value.images)
    return np.concatenate([branch.family.state(point.u)[None], images[: branch.family.period - 1]])


def _flags(words: Sequence[str]) -> dict[str, Any]:
    return {"flag_values": np.arange(len(words), dtype=np.int8), "flag_meanings": " ".join(words)}


def _side_flags() -> dict[str, Any]:
    return _flags([s.name.lower() for s in Side])


def _sides(branch: Branch, parameters: Parameters) -> np.ndarray:
    """Side of each orbit of a branch, from the whole orbit."""
    found = np.empty(len(branch.points), np.int8)
    base = _parameters_of(branch, parameters)
    for j, point in enumerate(branch.points):
        found[j] = _side(branch, point.u, base)
    return found


def _parameters_of(branch: Branch, parameters: Parameters) -> Parameters:
    names = [n for n in parameters.names if n not in branch.family.free]
    values = dict(zip(parameters.names, map(float, branch.family.parameters), strict=True))
    return parameters.replace(**{n: values[n] for n in names})


def _side(branch: Branch, u: np.ndarray, base: Parameters) -> int:
    family = branch.family
    name, value = family.free[0], float(family.values(u)[0])
    frequency = value if name == FREQUENCY else family.frequency_hz
    parameters = base if name == FREQUENCY else base.replace(**{name: value})
    times = np.arange(family.period * SAMPLES + 1) / (SAMPLES * frequency)
    states = trajectory(parameters, frequency, family.state(u), times)
    if np.any(np.round((states[-1, :2] - states[0, :2]) / (2.0 * np.pi)) != 0.0):
        return int(Side.ROTATING)
    offset = ARM_LENGTHS[0] * np.sin(states[:, 0]) + ARM_LENGTHS[1] * np.sin(states[:, 1])
    if (offset < 0.0).all():
        return int(Side.LEFT)
    return int(Side.RIGHT if (offset > 0.0).all() else Side.STRADDLING)


def _column(values: Any, dtype: str, long_name: str, **attrs: Any) -> tuple[np.ndarray, dict[str, Any]]:
    return np.asarray(values, dtype), {"units": "1", "long_name": long_name, **attrs}


def _per_branch(branches: Sequence[Branch], events: Sequence[tuple[int, Bifurcation]]) -> dict[str, Any]:
    numbers = {id(b): k for k, (_, b) in enumerate(events)}
    periods = [b.family.period for b in branches]
    frequencies = [np.nan if FREQUENCY in b.family.free else b.family.frequency_hz for b in branches]
    first, last = ([ENDS.index(b.ends[i]) for b in branches] for i in (0, 1))
    columns = {
        "orbit_period": _column(periods, "int32", "period in drive periods"),
        "n_points": _column([len(b.points) for b in branches], "int32", "points of the branch"),
        "origin": _column(
            [numbers.get(id(b.origin), -1) for b in branches], "int32", "bifurcation it sprang from, -1 none"
        ),
        "first_end": _column(first, "int8", "why it begins", **_flags(ENDS)),
        "last_end": _column(last, "int8", "why it ends", **_flags(ENDS)),
        "frequency_hz": _column(frequencies, "float64", "drive frequency, NaN if it varies", units="Hz"),
    }
    found: dict[str, Any] = {name: ("branch", *column) for name, column in columns.items()}
    turns = np.array([rotation_of(b) for b in branches]).reshape(len(branches), -1)
    found["rotation"] = (("branch", "link"), *_column(turns, "float64", "turns per drive period"))
    return found


def rotation_of(branch: Branch) -> np.ndarray:
    """Mean turns per drive period of each angle, from the branch's first orbit."""
    family = branch.family
    if not any(family.system.is_angle):
        return np.zeros(0)
    n = family.system.n_states
    rows = family.rows(branch.points[0].u[None])
    # with tangents in the error control, since that code is compiled already
    extended = dataclasses.replace(with_tangents(family.system, n), n_controlled=None)
    result = run_branches(
        rows.parameters[:, None], rows.frequency_hz[:, None], np.append(rows.states[0], np.eye(n))[None],
        n_transient=0, n_keep=family.period + 1, rtol=RTOL, atol=RTOL, system=extended,
    )  # fmt: skip
    return np.asarray(result.turns[0, 0] / family.period, np.float64)


def _per_event(
    branches: Sequence[Branch],
    events: Sequence[tuple[int, Bifurcation]],
    longest: int,
    n_states: int,
    arrays: _Arrays,
) -> dict[str, Any]:
    ones = [b for _, b in events]
    critical = np.array([b.critical_multiplier for b in ones], np.complex128)
    multipliers = np.array([multipliers_of(b.point) for b in ones], np.complex128).reshape(-1, n_states)
    section = np.full((len(events), longest, n_states), np.nan)
    for k, (i, b) in enumerate(events):
        section[k, : branches[i].family.period] = _orbit(branches[i], b.point)
    numbers = {id(b): i for i, b in enumerate(branches)}
    kinds, degrees = [KINDS.index(b.kind) for b in ones], [CRITICALITIES.index(b.criticality) for b in ones]
    values = [branches[i].family.values(b.point.u)[0] for i, b in events]
    children = [numbers.get(id(b.child), -1) for b in ones]
    sides = [arrays.side[i, max(b.after, 0)] for i, b in events]
    columns = {
        "kind": _column(kinds, "int8", "kind of bifurcation", **_flags(KINDS)),
        "value": _column(values, "float64", "parameter value of the bifurcation"),
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
        "criticality": _column(degrees, "int8", "criticality", **_flags(["unknown", *CRITICALITIES[1:]])),
        "bifurcation_side": _column(sides, "int8", "side of the orbit there", **_side_flags()),
        "critical_real": _column(critical.real, "float64", "critical multiplier, real part"),
        "critical_imag": _column(critical.imag, "float64", "critical multiplier, imaginary part"),
    }
    found: dict[str, Any] = {name: ("bifurcation", *column) for name, column in columns.items()}
    dims = ("bifurcation", "multiplier")
    found["bifurcation_multiplier_real"] = (dims, *_column(multipliers.real, "float64", "multipliers, real"))
    found["bifurcation_multiplier_imag"] = (
        dims,
        *_column(multipliers.imag, "float64", "multipliers, imaginary"),
    )
    found["bifurcation_section"] = (
        ("bifurcation", "phase", "state"),
        *_column(section, "float64", "section points of the orbit there", units=STATE_UNITS),
    )
    return found


# ---- tables ------------------------------------------------------------------------------------


def words(variable: xr.DataArray) -> list[str]:
    """Meanings of a flag variable's values."""
    meanings = str(variable.attrs["flag_meanings"]).split()
    return [meanings[int(v)] for v in variable.values]


def table_of(ds: xr.Dataset) -> list[dict[str, Any]]:
    """Located bifurcations by rising parameter value, one dict for each.

    ``unstable_below`` and ``unstable_above`` say how many multipliers are unstable on the two sides of the
    parameter; at a fold both orbits lie on one side, and the other says ``none``.
    """
    if not ds.sizes["bifurcation"]:
        return []
    kinds, sides = words(ds["kind"]), words(ds["bifurcation_side"])
    criticality = ["" if w == "unknown" else w for w in words(ds["criticality"])]
    rows = []
    for k in np.argsort(ds["value"].values, kind="stable"):
        one = ds.isel(bifurcation=int(k))
        before, after = int(one["n_unstable_before"]), int(one["n_unstable_after"])
        rises = bool(one["rises_before"])
        both = f"{min(before, after)}|{max(before, after)}"
        if kinds[k] == FOLD:
            below, above = (both, "none") if rises else ("none", both)
        else:
            below, above = (str(before), str(after)) if rises else (str(after), str(before))
        rows.append(
            {
                "value": float(one["value"]),
                "bracket": float(one["bracket"]),
                "type": kinds[k],
                "criticality": criticality[k],
                "period": int(ds["orbit_period"].values[int(one["of_branch"])]),
                "side": sides[k],
                "multiplier": complex(float(one["critical_real"]), float(one["critical_imag"])),
                "unstable_below": below,
                "unstable_above": above,
                "frequency_hz": float(ds["frequency_hz"][int(one["of_branch"])]),
                "branch": int(one["of_branch"]),
                "to_branch": int(one["to_branch"]),
            }
        )
    return rows


def windows_of(ds: xr.Dataset) -> list[dict[str, Any]]:
    """Stable segments of the branches, and what bounds each of them, by period, side and parameter."""
    found = []
    for i in range(ds.sizes["branch"]):
        n = int(ds["n_points"][i])
        for first, last in _stable_runs(ds["n_unstable"].values[i, :n] == 0, _ends_of(ds, i)[0] == "closed"):
            ends = sorted([_bound(ds, i, first, first - 1, 0), _bound(ds, i, last, last, 1)])
            middle = (first + (last - first) % n // 2) % n
            found.append(
                {
                    "from": ends[0][0],
                    "to": ends[1][0],
                    "begins": ends[0][1],
                    "ends": ends[1][1],
                    "period": int(ds["orbit_period"][i]),
                    "side": words(ds["side"][i, middle : middle + 1])[0],
                    "frequency_hz": float(ds["frequency_hz"][i]),
                    "branch": i,
                }
            )
    return sorted(found, key=lambda w: (w["period"], w["side"], w["from"]))


def _stable_runs(stable: np.ndarray, closed: bool) -> list[tuple[int, int]]:
    """First and last points of runs of stable points; on a closed branch the ends hang together."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], stable.astype(np.int8), [0]])))
    runs = [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]
    if closed and len(runs) > 1 and stable[0] and stable[-1]:
        runs = [(runs[-1][0], runs[0][1]), *runs[1:-1]]
    return runs


def _ends_of(ds: xr.Dataset, branch: int) -> tuple[str, str]:
    rows = ds.isel(branch=slice(branch, branch + 1))
    return words(rows["first_end"])[0], words(rows["last_end"])[0]


def _bound(ds: xr.Dataset, branch: int, point: int, after: int, end: int) -> tuple[float, str]:
    """Parameter value and name of what bounds a stable segment: a bifurcation after `after`, or the end."""
    here = np.flatnonzero((ds["of_branch"].values == branch) & (ds["after"].values == after))
    value = float(ds["parameter"][branch, point])
    if len(here):
        return _named(ds, int(here[0 if end else -1]))
    if point not in (0, int(ds["n_points"][branch]) - 1):
        return value, "not located"
    origins = np.flatnonzero(ds["to_branch"].values == branch)
    name = _ends_of(ds, branch)[end]
    if name in ("start", "period_halving") and len(origins):
        nearest = origins[np.argmin(np.abs(ds["value"].values[origins] - value))]
        parent = int(ds["orbit_period"][int(ds["of_branch"][nearest])])
        at, kind = _named(ds, int(nearest))
        return at, f"{kind} of period {parent}"
    return value, name


def _named(ds: xr.Dataset, k: int) -> tuple[float, str]:
    criticality = words(ds["criticality"][k : k + 1])[0]
    name = words(ds["kind"][k : k + 1])[0]
    return float(ds["value"][k]), name if criticality == "unknown" else f"{criticality} {name}"
