"""Measure the response of a run's attractors to shocks, as an analysis (`pipeline.analysis.resilience.declaration`).

The Dataset has a row for each set (`pipeline.results.ragged`), and the dim ``state``. Sizes are in units of the
states' scales (coordinate ``state_scale``), jumps of states in their own units.

`pipeline.analysis.resilience.declaration` lists the variables.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.models.text.grammar import Tree
from pipeline.analysis.attractors.destinations import Destinations, Followed, destinations_at
from pipeline.analysis.attractors.finding.points import SECTION_BYTES, Dynamics, slabs
from pipeline.analysis.basins.analysis import check_starts
from pipeline.analysis.resilience.declaration import ResilienceOptions
from pipeline.analysis.resilience.local import local_stability
from pipeline.analysis.resilience.shocks import (
    Asked,
    Bases,
    Found,
    Norm,
    Seeds,
    Trials,
    bases_of,
    search_together,
    sizes,
)
from pipeline.layout.vocabulary import ATTRACTS, letter, model_of, section_attributes, split_dims, told_by
from pipeline.products.product import Table
from pipeline.results.expressions import check_density, density_at, mean_over_cells
from pipeline.results.intervals import binomial_interval
from pipeline.results.outcomes import DIVERGED, outcomes
from pipeline.results.ragged import N_IDS, ROW_SIZE, SET, dims_of, rows_at
from pipeline.results.run import OpenRun
from pipeline.results.selection import listed, refuse_origins, select_points, start_states
from pipeline.results.sets import Geometry
from pipeline.results.tabular import (
    FEW_POINTS,
    Row,
    Words,
    number,
    point_table,
    points_of,
    ranges,
    sets_of,
    summary,
    values,
    with_interval,
)
from pipeline.specification.expressions import read_expression

_ENDS = {-1: "-", DIVERGED: "diverges", -3: "elsewhere"}

_STABILITY, _WEIGHTED, _ARRIVED = (
    [f"{name}{end}" for end in ("", "_low", "_high")] for name in ("basin_stability", "weighted_stability", "arrived")
)

_NUMBERS = (
    *(*_STABILITY, *_WEIGHTED, "n_effective", *_ARRIVED, "mean_time", "mean_time_stderr", "longest_time", "n_timed"),
    *("weighted_time", "weighted_arrived", "reactivity", "amplification", "amplification_time", "return_time"),
    "quantity",
)
"""Numbers of an attractor."""

_PLAIN = ("n_cells", *_NUMBERS)

_SIZES = ("shock_low", "shock_high", "shock_phase", "distance_low", "distance_high", "orbit_period")
"""Results that `quantity` may use beside those of `_PLAIN`."""

_SHOWN = ("low", "high", "phase", "to", "safe", "n_below", "n_undecided")


def needs_sweep(run: OpenRun, options: ResilienceOptions) -> None:
    """Raise ValueError unless the run has independent initial states and the options suit it."""
    cube = run.cube()
    check_starts(cube)
    refuse_origins(cube, "resilience")
    select_points(cube, options.at)
    _chosen(run, options)
    check_density(run, options.density)
    _asked_quantity(run, options)


def settle_resilience(run: OpenRun, options: ResilienceOptions) -> ResilienceOptions:
    """Complete the names of the shocked states."""
    return options.model_copy(update={"states": ",".join(_chosen(run, options))})


def _chosen(run: OpenRun, options: ResilienceOptions) -> list[str]:
    """Return the names of the shocked states: those given, or the rates of other states, or all states."""
    model, given = run.model, listed(options.states)
    unknown = [name for name in given if name not in model.state_names]
    if unknown:
        raise ValueError(f"states = {unknown[0]!r} is no state of {model.name}; use {', '.join(model.state_names)}.")
    wanted = given or [state.rate for state in model.states if state.rate] or model.state_names
    return [name for name in model.state_names if name in wanted]


def _asked_quantity(run: OpenRun, options: ResilienceOptions) -> Tree | None:
    """Return the parsed expression of the user's own quantity; None if there is none."""
    if not options.quantity:
        return None
    results = {*_PLAIN, *_SIZES} - {"quantity"}
    return read_expression("quantity", options.quantity, [*results, *run.model.parameter_names, *run.model.state_names])


def _by_name(run: OpenRun, states: np.ndarray) -> dict[str, np.ndarray]:
    """Return initial states (cell, state) by the names of the states."""
    return dict(zip(run.model.state_names, states.T, strict=True))


def resilience(run: OpenRun, options: ResilienceOptions) -> xr.Dataset:
    """Measure the response of the attractors at each parameter point to shocks."""
    attractors, cube = (select_points(ds, options.at) for ds in (run.derive("attractors"), run.cube()))
    dims, starts = split_dims(attractors["attractor_id"])
    labels = outcomes(attractors).transpose(*dims, *starts).values
    states = start_states(cube, starts)
    by_name = _by_name(run, states)
    timed = np.sort(np.random.default_rng(options.seed).permutation(len(states))[: options.timed])
    result = _Result(run, options, attractors)
    for points in slabs(cube, Dynamics.of(cube), SECTION_BYTES):
        for index, there in destinations_at(cube, attractors, points):
            assert there.point.parameters is not None
            known, own = {"f": there.point.frequency, **there.point.parameters}, labels[index].ravel()
            weights = density_at(options.density, known, by_name)
            result.count(index, own, weights)
            result.time(index, there.follow(states[timed], options.near), weights[timed])
            result.shocks(index, there, states, own)
            result.local(index, there)
            result.quantity(index, {**known, **by_name}, own, weights)
    return result.dataset()


def _nearest_seeds(there: Destinations, bases: Bases, states: np.ndarray, labels: np.ndarray, norm: Norm) -> Seeds:
    """Return the cells nearest to each base state, as shocks from it, with their labels."""
    most = 8  # cells of other basins that start a search of the distance in any direction, for each base state
    base, shock, label = [], [], []
    for k, state in enumerate(bases.states):
        jumps = Geometry.in_units(there.point.integrates).difference(states, state)
        nearest = np.argsort(sizes(jumps, norm), kind="stable")[:most]
        base.append(np.full(len(nearest), k))
        shock.append(jumps[nearest])
        label.append(labels[nearest])
    return Trials(np.concatenate(base), np.concatenate(shock)), np.concatenate(label)


_SEARCHED = ("low", "high", "phase", "to", "safe", "n_below", "n_undecided")
"""Results of a search that are kept."""


class _Result:
    """Arrays of the result, filled point by point."""

    def __init__(self, run: OpenRun, options: ResilienceOptions, attractors: xr.Dataset) -> None:
        self._run, self._options, self._attractors = run, options, attractors
        number = attractors["attractor"].values.tolist()
        self._rows = {at: {number[row]: row for row in rows} for at, rows in rows_at(attractors).items()}
        self._attracts = attractors["stability"].values == ATTRACTS
        self._units = np.asarray(run.model.units)
        self._values: dict[str, np.ndarray] = {}
        for what in ("shock", "distance"):
            for name in ("", "_from"):
                self._new(f"{what}{name}", by_state=True)
            for name in _SEARCHED:
                self._new(f"{what}_{name}")
        for name in ("along", "along_low", "along_high", "along_to", "along_n_undecided"):
            self._new(name, by_state=True)
        for name in _NUMBERS:
            self._new(name)

    def _new(self, name: str, by_state: bool = False) -> None:
        """Make an array of a variable: of counts if its name has ``n_``, of ids if it ends in ``_to``."""
        shape = (self._attractors.sizes[SET], *([len(self._units)] if by_state else []))
        is_count = name.startswith("n_timed") or "_n_" in name
        fill, dtype = (0, "int64") if is_count else (-1, "int32") if name.endswith("_to") else (np.nan, "float64")
        self._values[name] = np.full(shape, fill, dtype)

    def _attracting(self, index: tuple[int, ...]) -> list[tuple[int, int]]:
        """Return the ids and rows of the sets of a parameter point that attract."""
        return [(own, row) for own, row in self._rows[index].items() if self._attracts[row]]

    def _share(self, name: str, at: int, count: float, n: float) -> None:
        ends = binomial_interval(count, n, confidence=self._options.confidence, method=self._options.interval)
        for end, value in zip(("", "_low", "_high"), (count / n if n else np.nan, *ends), strict=True):
            self._values[f"{name}{end}"][at] = value

    def count(self, index: tuple[int, ...], labels: np.ndarray, weights: np.ndarray) -> None:
        """Fill in the shares of the cells that end on each attractor of a parameter point, plain and weighed."""
        total, squares = weights.sum(), (weights**2).sum()
        # of weighed cells the share has the variance of as many independent cells (Kish, Survey Sampling, 1965)
        effective = total**2 / squares if squares > 0.0 else 0.0
        for own, row in self._attracting(index):
            here = labels == own
            self._share("basin_stability", row, int(here.sum()), len(labels))
            share = min(weights[here].sum() / total, 1.0) if effective else 0.0
            self._share("weighted_stability", row, share * effective, effective)
            self._values["n_effective"][row] = effective

    def time(self, index: tuple[int, ...], found: Followed, weights: np.ndarray) -> None:
        """Fill in the arrival times of initial states, by attractor."""
        label, entered, put = found.label, found.entered, self._values
        counted, total = len(label), weights.sum()
        for i in np.unique(label[label >= 0]).tolist():
            chosen, at = (label == i) & np.isfinite(entered), self._rows[index][i]
            own, weight = entered[chosen], weights[chosen]
            in_time = own <= self._options.within
            put["n_timed"][at] = len(own)
            self._share("arrived", at, int(in_time.sum()), counted)
            if len(own):
                put["mean_time"][at], put["longest_time"][at] = own.mean(), own.max()
            if total > 0.0:
                put["weighted_arrived"][at] = weight[in_time].sum() / total
            if weight.any():
                put["weighted_time"][at] = np.average(own, weights=weight)
            if len(own) > 1:
                put["mean_time_stderr"][at] = own.std(ddof=1) / np.sqrt(len(own))

    def local(self, index: tuple[int, ...], there: Destinations) -> None:
        """Fill in the stability of the attractors of a parameter point against small disturbances."""
        point = there.point
        assert point.parameters is not None
        for own in np.flatnonzero(there.here["stability"].values == ATTRACTS).tolist():
            one = there.here.isel(attractor=own)
            found = local_stability(one, point.parameters, point.frequency, self._units)
            for name, value in found._asdict().items():
                self._values[name][self._rows[index][own]] = value

    def quantity(self, index: tuple[int, ...], known: dict[str, Any], labels: np.ndarray, weights: np.ndarray) -> None:
        """Fill in the user's own quantity, from the other results of a parameter point."""
        tree = _asked_quantity(self._run, self._options)
        if tree is None:
            return
        for own, row in self._attracting(index):
            results = {name: values[row] for name, values in self._values.items() if values.ndim == 1}
            results |= {name: float(self._attractors[name].values[row]) for name in ("orbit_period", "n_cells")}
            self._values["quantity"][row] = mean_over_cells(tree, {**known, **results}, weights * (labels == own))

    def shocks(self, index: tuple[int, ...], there: Destinations, states: np.ndarray, labels: np.ndarray) -> None:
        """Search the shocks of each attractor: of the chosen states, of all states, and of each state alone."""
        point, options = there.point, self._options
        assert point.parameters is not None
        which = np.array([self._run.model.state_names.index(name) for name in _chosen(self._run, options)])
        every = np.arange(len(self._units))
        asked: dict[tuple[int, str], Asked] = {}
        for own in sorted(there.told):
            bases = bases_of(there.here.isel(attractor=own), point.parameters, point.frequency, options.phases)
            asked[own, "shock"] = Asked.of(own, bases, which, options)
            away = (labels != own) & (labels != -1)
            seeds = _nearest_seeds(there, bases.sections, states[away], labels[away], options.norm)
            asked[own, "distance"] = Asked.of(own, bases.sections, every, options, seeds)
            for i in every.tolist():
                asked[own, str(i)] = Asked.of(own, bases.sections, every[[i]], options)
        for (own, what), one in search_together(asked, there, self._units).items():
            at = self._rows[index][own]
            if what in ("shock", "distance"):
                self._shock(what, at, one, asked[own, what])
            else:
                self._searched("along", (at, int(what)), one)
                self._values["along"][at, int(what)] = one.shock[0] * self._units[int(what)]

    def _shock(self, what: str, at: int, one: Found, asked: Asked) -> None:
        self._searched(what, at, one)
        if one.base >= 0:
            jump = np.zeros(len(self._units))
            jump[asked.which] = one.shock
            self._values[what][at] = jump * self._units
            self._values[f"{what}_phase"][at] = asked.bases.phase[one.base]
            self._values[f"{what}_from"][at] = asked.bases.states[one.base]

    def _searched(self, name: str, at: Any, one: Found) -> None:
        for key in ("low", "high", "to", "safe", "n_below", "n_undecided"):
            if f"{name}_{key}" in self._values:
                self._values[f"{name}_{key}"][at] = getattr(one, key)

    def dataset(self) -> xr.Dataset:
        """Return all arrays, with the attractors' features."""
        kept = [name for name in ("kind", "stability", "orbit_period", "n_cells", "side") if name in self._attractors]
        found, plain = self._attractors[[ROW_SIZE, *kept]], self._options.plain()
        own = {n: ((SET, "state")[: v.ndim], v) for n, v in self._values.items()}
        attrs = {**told_by(found.attrs), **section_attributes(self._run.model.crossing), "title": "resilience"}
        options = ("phases", "largest", "norm", "within", "near", "timed", "density", "quantity")
        attrs |= {f"resilience_{name}": value for name, value in plain.items() if name in options}
        attrs |= {"resilience_states": ", ".join(_chosen(self._run, self._options)), N_IDS: found.attrs[N_IDS]}
        states = {k: v.variable for k, v in self._attractors.coords.items() if k in ("state", "state_units")}
        states["state_scale"] = xr.Variable("state", self._units, {"units": "see state_units"})
        return found.assign(own).assign_coords(states).drop_attrs(deep=False).assign_attrs(attrs)


def end_of(label: int) -> str:
    """Return the letter of the attractor where a shock leads, or a word for another end."""
    return _ENDS.get(label) or letter(label)


def resilience_table(ds: xr.Dataset) -> Table:
    """Return a row per attractor and parameter point; of more than a few points, print a line per attractor."""
    dims = dims_of(ds)
    rows = _rows(ds)
    lines = [_head(ds)]
    if int(np.prod([ds.sizes[d] for d in dims])) > FEW_POINTS:
        lines += summary(ds, rows, dims, _label_summary, "attractor_id")
    else:
        for _, where in points_of(ds, dims):
            lines += point_table(ds, where, rows, partial(_words, ds.attrs))
    lines.append(
        "the largest shocks that never led away, and the numbers of smaller ones tried, are in --csv and --json"
    )
    n_unknown = sum(row["shock_n_undecided"] + row["distance_n_undecided"] for row in rows)
    if n_unknown:
        lines.append(f"{n_unknown} smaller shocks end on no known attractor; sizes are intervals where that matters")
    return Table(rows, lines, "" if rows else "no attractor of the run can be disturbed: none was shown to attract.")


def _head(ds: xr.Dataset) -> str:
    norm = {"euclidean": "root of the sum of squares", "largest": "largest"}[ds.attrs["resilience_norm"]]
    scales = zip(ds["state"].values, ds["state_scale"].values, strict=True)
    units = ", ".join(f"{name} {scale:g}" for name, scale in scales)
    periods = model_of(ds).clock.periods
    n_phases = model_of(ds).clock.samples(int(ds.attrs["resilience_phases"]))
    return (
        f"shocks of {ds.attrs['resilience_states']} at {n_phases} phase{'s' * (n_phases > 1)}, distances of all "
        f"states; sizes: {norm} of the jumps over their scales ({units}); times in {periods}, "
        f"return times in {model_of(ds).clock.unit}"
    )


def _rows(ds: xr.Dataset) -> list[Row]:
    rows = []
    names = [str(name) for name in ds["state"].values]
    for where, one in sets_of(ds, ds["stability"].values == ATTRACTS):
        i = int(one["attractor"])
        row: Row = {**where, "attractor_id": i, "letter": letter(i), **values(one, *_PLAIN)}
        for what in ("shock", "distance"):
            row |= values(one, *(f"{what}_{name}" for name in _SHOWN))
            row[f"{what}_leads_to"] = end_of(int(one[f"{what}_to"]))
            row |= {f"{what}_{name}": float(one[what][k]) for k, name in enumerate(names)}
            row |= {f"{what}_from_{name}": float(one[f"{what}_from"][k]) for k, name in enumerate(names)}
        for k, name in enumerate(names):
            row |= {f"along_{name}_{end}": float(one[f"along_{end}"][k]) for end in ("low", "high")}
            row |= {f"along_{name}": float(one["along"][k]), f"along_{name}_leads_to": end_of(int(one["along_to"][k]))}
        rows.append(row)
    return rows


def size_of(low: float, high: float) -> str:
    """Format the interval of a size: a number where it is short, else both ends."""
    if not np.isfinite(low):
        return "-"
    if np.isinf(high):
        return f"above {low:.4g}"
    return f"{high:.5g}" if high - low <= 1e-3 * high else f"{low:.4g} to {high:.4g}"


def _words(attrs: Mapping[str, Any], row: Row) -> Words:
    is_weighed, has_quantity = attrs["resilience_density"] != "1", attrs["resilience_quantity"] != ""
    return {
        "letter": row["letter"],
        "basin stability": with_interval(row, _STABILITY, ".4f"),
        "in time": number(row["arrived"], ".3f"),
        "mean time": number(row["mean_time"], ".1f"),
        "longest": number(row["longest_time"], ".0f"),
        "critical shock": size_of(row["shock_low"], row["shock_high"]),
        "phase": number(row["shock_phase"], ".3g"),
        "to": row["shock_leads_to"],
        "distance": size_of(row["distance_low"], row["distance_high"]),
        "to ": row["distance_leads_to"],
        "weighted stability": with_interval(row, _WEIGHTED, ".4f") if is_weighed else None,
        "weighted in time": number(row["weighted_arrived"], ".3f") if is_weighed else None,
        "weighted time": number(row["weighted_time"], ".1f") if is_weighed else None,
        "reactivity": number(row["reactivity"], ".4g"),
        "amplification": number(row["amplification"], ".4g"),
        "return time": number(row["return_time"], ".4g"),
        "quantity": number(row["quantity"], ".6g") if has_quantity else None,
    }


def _label_summary(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str]) -> Words:
    def span(name: str, spec: str) -> str:
        found = [row[name] for row in rows if np.isfinite(row[name])]
        return f"{min(found):{spec}} to {max(found):{spec}}" if found else "-"

    least = min(rows, key=lambda row: row["shock_high"])
    where = ", ".join(f"{d} {least[d]:g}" for d in dims)
    return {
        "letter": rows[0]["letter"],
        **ranges(ds, rows, dims),
        "basin stability": span("basin_stability", ".3f"),
        "mean time": span("mean_time", ".1f"),
        "critical shock": span("shock_high", ".4g"),
        "least at": where if np.isfinite(least["shock_high"]) else "-",
        "distance": span("distance_high", ".4g"),
        "weighted stability": span("weighted_stability", ".3f") if ds.attrs["resilience_density"] != "1" else None,
        "amplification": span("amplification", ".4g"),
        "return time": span("return_time", ".4g"),
        "quantity": span("quantity", ".6g") if ds.attrs["resilience_quantity"] else None,
    }
