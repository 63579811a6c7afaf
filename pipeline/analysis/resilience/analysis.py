"""Measure the response of a run's attractors to shocks, as an analysis (`pipeline.products.resilience`).

The Dataset has a row for each set (`pipeline.analysis.ragged`), and the dim ``state``. Sizes are in units of the
states' scales (coordinate ``state_scale``), jumps of states in their own units.

===============================  =============================================================================
variable                         meaning
===============================  =============================================================================
``basin_stability``, ``_low``,   share of the cells that end on the attractor, with its interval
``_high``, ``n_cells``
``weighted_stability``, ``_low``,  the same, each cell weighed by the density; ``n_effective`` independent cells of
``_high``, ``n_effective``       equal weight would have the same error
``arrived``, ``_low``, ``_high``  share of timed initial states that have arrived within `within` periods
``mean_time``, ``_stderr``,      time until arrival of the timed initial states [drive periods or returns]
``longest_time``, ``n_timed``
``weighted_time``,               mean of these times, each weighed by the density, and share of the density of the
``weighted_arrived``             timed initial states that has arrived within `within` periods
``reactivity``, ...              `local.Local`: growth of small disturbances at once and later, and their decay
``quantity``                     value of the expression `quantity`
``shock_low``, ``shock_high``    interval of the smallest critical shock of the chosen states, at any phase
``shock``                        its jump of each state
``shock_phase``                  its phase: a share of the drive period, or of the period of a flow's orbit
``shock_from``                   the state on the attractor at that phase
``shock_to``                     id of the attractor where it leads, -1 nowhere, -2 diverges, -3 elsewhere
``shock_safe``                   size of the largest shell of which all shocks stayed
``shock_n_below``                smaller shocks that were tried, all of which stayed
``shock_n_undecided``            smaller shocks whose end is not known
``distance_...``                 the same for jumps of all states at the section
``along_low``, ``along_high``,   the same for each state alone; ``along`` is its signed jump
``along``, ``along_to``
===============================  =============================================================================
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.models.text.grammar import Tree
from pipeline.analysis.attractors.destinations import Destinations, destinations_at
from pipeline.analysis.attractors.finding.points import BUDGET, Dynamics, slabs
from pipeline.analysis.basins.analysis import check_starts
from pipeline.analysis.intervals import binomial_interval
from pipeline.analysis.outcomes import DIVERGED, outcomes
from pipeline.analysis.ragged import N_IDS, ROW_SIZE, SET, dims_of, rows_at
from pipeline.analysis.resilience.expressions import density_at, mean_over_cells, read_expression
from pipeline.analysis.resilience.local import Local, local_stability
from pipeline.analysis.resilience.shocks import (
    Asked,
    Bases,
    Found,
    Settings,
    Shocked,
    ShockSearch,
    Trials,
    bases_of,
    search_together,
)
from pipeline.analysis.run import OpenRun
from pipeline.analysis.selection import select_points
from pipeline.analysis.tabular import (
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
from pipeline.layout.evaluation import parameter_points
from pipeline.layout.vocabulary import (
    ATTRACTS,
    grid_dim,
    letter,
    model_of,
    periods_of,
    samples_per_period,
    section_attributes,
    split_dims,
    time_unit,
    told_by,
)
from pipeline.products.product import Table
from pipeline.products.resilience import ResilienceOptions
from pipeline.specification.tables import FREQUENCY

PRECISION = 1e-6
"""Relative length to which the last ray of a search is divided."""

MOST_SEEDS = 8
"""Cells of other basins that start a search of the distance in any direction, for each base state."""

_ENDS = {-1: "-", DIVERGED: "diverges", -3: "elsewhere"}

_STABILITY, _WEIGHTED, _ARRIVED = (
    [f"{name}{end}" for end in ("", "_low", "_high")] for name in ("basin_stability", "weighted_stability", "arrived")
)

_NUMBERS = {
    **dict.fromkeys(_STABILITY, ("share of the cells that end on it", "1")),
    **dict.fromkeys(_WEIGHTED, ("share of the density that ends on it", "1")),
    "n_effective": ("independent cells of equal weight with the same error", "1"),
    **dict.fromkeys(_ARRIVED, ("share of initial states that have arrived in time", "1")),
    "mean_time": ("mean time until arrival, drive periods or returns", "1"),
    "mean_time_stderr": ("standard error of the mean time", "1"),
    "longest_time": ("longest time until arrival, drive periods or returns", "1"),
    "n_timed": ("timed initial states that end on it", "1"),
    "weighted_time": ("mean time until arrival, weighed by the density", "1"),
    "weighted_arrived": ("share of the density that has arrived in time", "1"),
    "reactivity": ("largest growth rate of a small disturbance, at any phase", "1/{}"),
    "amplification": ("largest factor by which a small disturbance grows", "1"),
    "amplification_time": ("time after the disturbance at which it is largest", "{}"),
    "return_time": ("time in which small disturbances shrink by e at last", "{}"),
    "quantity": ("quantity of the option", "1"),
}
"""Numbers of an attractor: their meanings and units, {} of time."""

_PLAIN = ("n_cells", *_NUMBERS)

_SIZES = ("shock_low", "shock_high", "shock_phase", "distance_low", "distance_high", "orbit_period")
"""Results that `quantity` may use beside those of `_PLAIN`."""

_SHOWN = ("low", "high", "phase", "to", "safe", "n_below", "n_undecided")


def needs_sweep(run: OpenRun, options: ResilienceOptions) -> None:
    """Raise ValueError unless the run has independent initial states and the options suit it."""
    cube = run.cube()
    check_starts(cube)
    select_points(cube, options.at)
    _chosen(run, options)
    _, starts = split_dims(cube["status"])
    states = _by_name(run, start_states(cube, starts))
    for point in parameter_points(run.spec):
        density_at(options.density, {**point, "f": point[FREQUENCY]}, states)
    _asked_quantity(run, options)


def settle_resilience(run: OpenRun, options: ResilienceOptions) -> ResilienceOptions:
    """Complete the names of the shocked states."""
    return options.model_copy(update={"states": ",".join(_chosen(run, options))})


def _chosen(run: OpenRun, options: ResilienceOptions) -> list[str]:
    """Return the names of the shocked states: those given, or the rates of other states, or all states."""
    model = run.model
    given = [name.strip() for name in options.states.split(",") if name.strip()]
    unknown = [name for name in given if name not in model.state_names]
    if unknown:
        raise ValueError(f"states = {unknown[0]!r} is no state of {model.name}; use {', '.join(model.state_names)}.")
    rates = [state.rate for state in model.states if state.rate]
    wanted = given or rates or list(model.state_names)
    return [name for name in model.state_names if name in wanted]


def _places(run: OpenRun, options: ResilienceOptions) -> list[int]:
    return [run.model.state_names.index(name) for name in _chosen(run, options)]


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
    whole = run.derive("attractors")
    cube, attractors = select_points(run.cube(), options.at), select_points(whole, options.at)
    dims, starts = split_dims(attractors["attractor_id"])
    result = _Result(run, options, attractors)
    labels = outcomes(attractors).transpose(*dims, *starts).values
    states = start_states(cube, starts)
    for points in slabs(cube, Dynamics.of(cube), BUDGET):
        for index, there in destinations_at(cube, attractors, points):
            work, own = _Point(there, options, run), labels[index].ravel()
            weights = density_at(options.density, work.values, _by_name(run, states))
            result.count(index, own, weights)
            timed = work.timed(len(states))
            result.time(index, *work.times(states[timed]), weights[timed])
            result.shocks(index, work.shocks(states, own))
            result.local(index, work.local())
            result.quantity(index, {**work.values, **_by_name(run, states)}, own, weights)
    return result.dataset()


def start_states(cube: xr.Dataset, starts: tuple[str, ...]) -> np.ndarray:
    """Return the initial states of the cells of a parameter point, shape (cell, state)."""
    shape = tuple(cube.sizes[d] for d in starts)
    columns = []
    for name in cube["state"].values:
        column = cube[grid_dim(str(name))]
        own = xr.DataArray(np.ones(shape), dims=starts) * column.drop_vars(list(column.coords))
        columns.append(own.transpose(*starts).values.ravel())
    return np.column_stack(columns)


class _Point:
    """The attractors of one parameter point, with what is asked of them."""

    def __init__(self, there: Destinations, options: ResilienceOptions, run: OpenRun) -> None:
        self._there, self._options = there, options
        self._which = np.array(_places(run, options))
        self._scales = np.asarray(there.geometry.scales)
        o = options
        self._settings = Settings(o.largest, o.directions, o.norm, PRECISION, o.confirmations, o.seed)

    @property
    def values(self) -> dict[str, float]:
        """Values of the parameters by name, and the drive frequency ``f`` [Hz]."""
        assert self._there.point.parameters is not None
        return {**self._there.point.parameters, "f": self._there.point.frequency}

    def timed(self, n: int) -> np.ndarray:
        """Draw the numbers of the initial states, of `n`, whose arrival is timed."""
        rng = np.random.default_rng(self._options.seed)
        return np.sort(rng.permutation(n)[: self._options.timed])

    def times(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Integrate initial states anew; return the label and the arrival time of each."""
        found = self._there.follow(states, self._options.near)
        return found.label, found.entered

    def local(self) -> dict[int, Local]:
        """Measure the stability of each attractor against small disturbances."""
        here, point = self._there.here, self._there.point
        assert point.parameters is not None
        return {
            own: local_stability(here.isel(attractor=own), point.parameters, point.frequency, self._scales)
            for own in np.flatnonzero(here["stability"].values == ATTRACTS).tolist()
        }

    def shocks(self, states: np.ndarray, labels: np.ndarray) -> dict[tuple[int, str], tuple[Found, Bases]]:
        """Search the shocks of each attractor: of the chosen states, of all states, and of each state alone."""
        asked: dict[str, Asked] = {}
        every = np.arange(states.shape[1])
        parameters, frequency = self._there.point.parameters, self._there.point.frequency
        assert parameters is not None
        for own in sorted(self._there.told):
            bases = bases_of(self._there.here.isel(attractor=own), parameters, frequency, self._options.phases)
            asked[f"{own} shock"] = self._search(own, bases, self._which)
            at_section = bases.sections
            seeds = self._seeds(own, at_section, states, labels)
            asked[f"{own} any"] = self._search(own, at_section, every, seeds)
            for i in every:
                asked[f"{own} {i}"] = self._search(own, at_section, np.array([i]))
        found = search_together(asked, Shocked(self._there), self._scales, "trajectories after shocks")
        keys = {key: key.split() for key in found}
        return {(int(n), what): (found[key], asked[key].bases) for key, (n, what) in keys.items()}

    def _search(
        self, number: int, bases: Bases, which: np.ndarray, seeds: tuple[Trials, np.ndarray] | None = None
    ) -> Asked:
        search = ShockSearch(number, len(bases.states), len(which), self._settings, seeds)
        return Asked(search.run(), bases, which)

    def _seeds(
        self, number: int, bases: Bases, states: np.ndarray, labels: np.ndarray
    ) -> tuple[Trials, np.ndarray] | None:
        """Return the cells of other basins nearest to each base state, as shocks from it."""
        away = np.flatnonzero((labels != number) & (labels != -1))
        if not len(away):
            return None
        base, shock, label = [], [], []
        for k, state in enumerate(bases.states):
            jumps = self._there.geometry.difference(states[away], state)
            nearest = np.argsort(self._settings.size(jumps), kind="stable")[:MOST_SEEDS]
            base.append(np.full(len(nearest), k))
            shock.append(jumps[nearest])
            label.append(labels[away[nearest]])
        return Trials(np.concatenate(base), np.concatenate(shock)), np.concatenate(label)


_SEARCHED: dict[str, tuple[str, float, str]] = {
    "low": ("float64", np.nan, "no smaller shock leads away, as far as tried"),
    "high": ("float64", np.nan, "size of the smallest shock found that leads away"),
    "phase": ("float64", np.nan, "share of the period at which it happens"),
    "to": ("int32", -1, "attractor where it leads: -1 none, -2 diverges, -3 none of the run's"),
    "safe": ("float64", np.nan, "largest size of which all directions stayed"),
    "n_below": ("int64", 0, "smaller shocks that were tried and stayed"),
    "n_undecided": ("int64", 0, "smaller shocks whose end is not known"),
}


class _Result:
    """Arrays of the result, filled point by point."""

    def __init__(self, run: OpenRun, options: ResilienceOptions, attractors: xr.Dataset) -> None:
        self._run, self._options, self._attractors = run, options, attractors
        number = attractors["attractor"].values.tolist()
        self._rows = {at: {number[row]: row for row in rows} for at, rows in rows_at(attractors).items()}
        self._attracts = attractors["stability"].values == ATTRACTS
        self._n_states = attractors.sizes["state"]
        self.arrays: dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, Any]]] = {}
        for what, text in (("shock", "smallest critical shock"), ("distance", "shortest way out of the basin")):
            for name, (dtype, fill, meaning) in _SEARCHED.items():
                self._new(f"{what}_{name}", dtype, fill, f"{text}: {meaning}")
            self._new(what, "float64", np.nan, f"{text}: jump of each state", ("state",), "see state_units")
            self._new(f"{what}_from", "float64", np.nan, f"{text}: state before it", ("state",), "see state_units")
        for name, (dtype, fill, meaning) in _SEARCHED.items():
            if name in ("low", "high", "to", "n_undecided"):
                self._new(f"along_{name}", dtype, fill, f"boundary along a state: {meaning}", ("state",))
        self._new("along", "float64", np.nan, "boundary along a state: jump", ("state",), "see state_units")
        for name, (text, units) in _NUMBERS.items():
            dtype, fill = ("int64", 0) if name == "n_timed" else ("float64", np.nan)
            self._new(name, dtype, fill, text, units=units)

    def _new(self, name: str, dtype: str, fill: float, text: str, own: tuple[str, ...] = (), units: str = "1") -> None:
        values = np.full((self._attractors.sizes[SET], *(self._n_states for _ in own)), fill, dtype)
        units = units.format(time_unit(self._run.model))
        self.arrays[name] = ((SET, *own), values, {"units": units, "long_name": text})

    def _put(self, name: str, at: Any, value: Any) -> None:
        self.arrays[name][1][at] = value

    def _share(self, name: str, at: int, count: float, n: float) -> None:
        low, high = binomial_interval(count, n, confidence=self._options.confidence, method=self._options.interval)
        self._put(name, at, count / n if n else np.nan)
        self._put(f"{name}_low", at, low)
        self._put(f"{name}_high", at, high)

    def count(self, index: tuple[int, ...], labels: np.ndarray, weights: np.ndarray) -> None:
        """Fill in the shares of the cells that end on each attractor of a parameter point, plain and weighed."""
        counted = labels != -1
        total, squares = weights[counted].sum(), (weights[counted] ** 2).sum()
        # of weighed cells the share has the variance of as many independent cells (Kish, Survey Sampling, 1965)
        effective = total**2 / squares if squares > 0.0 else 0.0
        for own, row in self._rows[index].items():
            if self._attracts[row]:
                here = labels == own
                self._share("basin_stability", row, int(here.sum()), int(counted.sum()))
                share = min(weights[here].sum() / total, 1.0) if effective else 0.0
                self._share("weighted_stability", row, share * effective, effective)
                self._put("n_effective", row, effective)

    def time(self, index: tuple[int, ...], label: np.ndarray, entered: np.ndarray, weights: np.ndarray) -> None:
        """Fill in the arrival times of initial states, by attractor."""
        counted, total = int((label != -1).sum()), weights[label != -1].sum()
        for i in np.unique(label[label >= 0]).tolist():
            chosen, at = (label == i) & np.isfinite(entered), self._rows[index][i]
            own, weight = entered[chosen], weights[chosen]
            self._put("n_timed", at, len(own))
            self._share("arrived", at, int((own <= self._options.within).sum()), counted)
            if len(own):
                self._put("mean_time", at, own.mean())
                self._put("longest_time", at, own.max())
            if total > 0.0:
                self._put("weighted_arrived", at, weight[own <= self._options.within].sum() / total)
            if weight.any():
                self._put("weighted_time", at, np.average(own, weights=weight))
            if len(own) > 1:
                self._put("mean_time_stderr", at, own.std(ddof=1) / np.sqrt(len(own)))

    def local(self, index: tuple[int, ...], found: dict[int, Local]) -> None:
        """Fill in the stability of the attractors of a parameter point against small disturbances."""
        for own, one in found.items():
            for name, value in one._asdict().items():
                self._put(name, self._rows[index][own], value)

    def quantity(self, index: tuple[int, ...], known: dict[str, Any], labels: np.ndarray, weights: np.ndarray) -> None:
        """Fill in the user's own quantity, from the other results of a parameter point."""
        tree = _asked_quantity(self._run, self._options)
        if tree is None:
            return
        for own, row in self._rows[index].items():
            if self._attracts[row]:
                results = {name: values[row] for name, (dims, values, _) in self.arrays.items() if dims == (SET,)}
                more = {"orbit_period": float(self._attractors["orbit_period"].values[row])}
                results |= {**more, "n_cells": float(self._attractors["n_cells"].values[row])}
                self._put("quantity", row, mean_over_cells(tree, {**known, **results}, weights * (labels == own)))

    def shocks(self, index: tuple[int, ...], found: dict[tuple[int, str], tuple[Found, Bases]]) -> None:
        """Fill in the critical shocks of a parameter point."""
        scales = np.asarray(self._run.model.scales)
        which = _places(self._run, self._options)
        for (own, what), (one, bases) in found.items():
            at = self._rows[index][own]
            if what not in ("shock", "any"):
                self._searched("along", (at, int(what)), one)
                self._put("along", (at, int(what)), one.shock[0] * scales[int(what)])
                continue
            name = "shock" if what == "shock" else "distance"
            self._searched(name, at, one)
            if one.base < 0:
                continue
            jump = np.zeros(self._n_states)
            jump[which if what == "shock" else slice(None)] = one.shock
            self._put(name, at, jump * scales)
            self._put(f"{name}_phase", at, bases.phase[one.base])
            self._put(f"{name}_from", at, bases.states[one.base])

    def _searched(self, name: str, at: Any, one: Found) -> None:
        for key in ("low", "high", "to", "safe", "n_below", "n_undecided"):
            if f"{name}_{key}" in self.arrays:
                self._put(f"{name}_{key}", at, getattr(one, key))

    def dataset(self) -> xr.Dataset:
        """Return all arrays, with the attractors' features."""
        kept = [name for name in ("kind", "stability", "orbit_period", "n_cells", "side") if name in self._attractors]
        found, options = self._attractors[[ROW_SIZE, *kept]], self._options
        scales = ("state", np.asarray(self._run.model.scales), {"long_name": "size that counts as 1"})
        attrs = {**told_by(found.attrs), **section_attributes(self._run.model.crossing), "title": "resilience"}
        plain = {
            k: v
            for k, v in options.plain().items()
            if k in ("phases", "largest", "norm", "within", "near", "timed", "density", "quantity")
        }
        attrs |= {f"resilience_{k}": v for k, v in plain.items()}
        attrs |= {"resilience_states": ", ".join(_chosen(self._run, options)), N_IDS: found.attrs[N_IDS]}
        states = {k: v.variable for k, v in self._attractors.coords.items() if k in ("state", "state_units")}
        result = found.assign(self.arrays).assign_coords({**states, "state_scale": scales})
        return result.drop_attrs(deep=False).assign_attrs(attrs)


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
    periods = periods_of(model_of(ds))
    n_phases = samples_per_period(model_of(ds), int(ds.attrs["resilience_phases"]))
    return (
        f"shocks of {ds.attrs['resilience_states']} at {n_phases} phase{'s' * (n_phases > 1)}, distances of all "
        f"states; sizes: {norm} of the jumps over their scales ({units}); times in {periods}, "
        f"return times in {time_unit(model_of(ds))}"
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
