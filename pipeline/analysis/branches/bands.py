"""Carry draws of the parameters through the branches of a diagram: intervals of bifurcations, bands about orbits.

No branch is followed again: each orbit and each bifurcation is carried from the parameters of the diagram to those of a
draw by Newton's method (`carrying`). An orbit that is lost on the way counts as missing.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.models.model import Parameters
from pipeline.analysis.branches.arclength import Point
from pipeline.analysis.branches.carrying import (
    ORBIT,
    PARAMETER,
    Along,
    Array,
    Datum,
    OrbitData,
    Solution,
    raw_of,
    settled,
    solve,
)
from pipeline.analysis.branches.declaration import BandOptions
from pipeline.analysis.branches.intervals import interval_along, settle_along
from pipeline.analysis.branches.kinds import DOUBLING, FOLD, HOPF, LABELS, TORUS
from pipeline.analysis.branches.problems import FREQUENCY
from pipeline.layout.vocabulary import axis_name, parameter_name, parameters_of
from pipeline.products.product import Table
from pipeline.products.reporting import report
from pipeline.results.draws import LEVELS, interval_of
from pipeline.results.run import OpenRun
from pipeline.results.tabular import aligned, words_of
from pipeline.specification.problems import SpecError

GRID = 41
"""Values of the parameter at which bands are computed."""


FOLLOWED = (FOLD, DOUBLING, TORUS, HOPF)
"""Kinds of bifurcations that get an interval."""

DRAWS_FILE = "posterior.nc"
"""Name of the file of draws in the directory of an identification."""


@dataclass(frozen=True)
class Place:
    """Place of a carried orbit in a diagram."""

    branch: int  # index of the branch
    run: int  # number of the stretch of the branch in which the parameter keeps rising or falling
    step: int  # index of the value of the parameter, of `GRID` ones


def bifurcation_data(branches: xr.Dataset) -> tuple[list[Datum], list[np.ndarray], list[int]]:
    """Return the located bifurcations of computed branches as data to be carried, their orbits with the value of the
    parameter, and their indices.
    """
    if "kind" not in branches:
        return [], [], []
    words, periods = words_of(branches["kind"]), branches["orbit_period"].values[branches["of_branch"].values]
    data, states, chosen = [], [], []
    for e, value in enumerate(branches["value"].values):
        kind, period = words[int(branches["kind"].values[e])], int(periods[e])
        if kind in FOLLOWED:
            one = np.ones(1)
            data.append(Datum(f"{kind} {e}", kind, float(value), period, 0, (PARAMETER,), one * value, one))
            states.append(np.append(branches["bifurcation_section"].values[e, 0], value))
            chosen.append(e)
    return data, states, chosen


def orbit_data(
    along: Along, branches: xr.Dataset, quantities: tuple[str, ...] = ()
) -> tuple[list[Datum], list[np.ndarray], list[Place]]:
    """Return orbits of computed branches at even values of the parameter as data to be carried, guesses of their
    section points with the value of the parameter, and their places.
    """
    found, guesses, places = [], [], []
    none = np.full(len(quantities), np.nan)
    for i in range(branches.sizes["branch"]):
        n, period = int(branches["n_points"][i]), int(branches["orbit_period"][i])
        if not period:
            continue
        x = branches["parameter"].values[i, :n]
        rising = np.sign(np.diff(x))
        turns = np.concatenate([[0], np.cumsum(np.diff(rising) != 0)])
        is_stable = branches["n_unstable"].values[i, :n] == 0
        for step, value in enumerate(np.linspace(along.low, along.high, GRID)):
            for j in np.flatnonzero((x[:-1] - value) * (x[1:] - value) <= 0.0):
                share = (value - x[j]) / (x[j + 1] - x[j]) if x[j + 1] != x[j] else 0.0
                stability = 1 if is_stable[j if share < 0.5 else j + 1] else 2
                datum = Datum(f"{i} {j} {value!r}", ORBIT, float(value), period, stability, quantities, none, none)
                a, b = branches["section"].values[i, j : j + 2, 0]
                found.append(datum)
                guesses.append(np.append(a + share * (b - a), value))
                places.append(Place(i, int(turns[j]), step))
    return found, guesses, places


def solvable(table: OrbitData) -> tuple[OrbitData, list[int]]:
    """Return the table without data whose equations cannot be solved at the known parameters, the others solved, and
    the indices of these.
    """
    everything = list(range(len(table.data)))
    whole = settled(table)
    if whole is not None:
        return whole, everything
    keep = []
    for k in everything:
        known = Solution(table.known.packed, table.known.unknowns[k : k + 1], table.known.tangents[k : k + 1])
        one = settled(replace(table, data=(table.data[k],), known=known))
        if one is not None:
            keep.append((k, one.known))
    rows = [np.zeros((0, table.known.unknowns.shape[1]))]
    unknowns, tangents = (
        np.concatenate([*rows, *(getattr(own, name) for _, own in keep)]) for name in ("unknowns", "tangents")
    )
    chosen = [k for k, _ in keep]
    known = Solution(table.known.packed, unknowns, tangents)
    return replace(table, data=tuple(table.data[k] for k in chosen), known=known), chosen


def carried(table: OrbitData, packed: Array) -> Iterator[tuple[Array, list[list[Point | None]]]]:
    """Yield some rows of packed parameters with the orbits and bifurcations carried to them, until all are done."""
    at_once = 16  # draws that are carried in one call of the engine
    for first in range(0, len(packed), at_once):
        report("draws", first, len(packed))
        own = packed[first : first + at_once]
        yield own, solve(table, own)


def place_variables(data: list[Datum], places: list[Place], share: np.ndarray) -> dict[str, tuple[str, np.ndarray]]:
    """Return the variables over ``orbit`` that `stretches` reads, and the value of the parameter."""
    return {
        "branch": ("orbit", np.array([p.branch for p in places], np.int64)),
        "run": ("orbit", np.array([p.run for p in places], np.int64)),
        "step": ("orbit", np.array([p.step for p in places], np.int64)),
        "parameter_value": ("orbit", np.array([d.value for d in data], np.float64)),
        "is_stable": ("orbit", np.array([d.stability == 1 for d in data], bool)),
        "share": ("orbit", share),
    }


def settle_bands(run: OpenRun, options: BandOptions) -> BandOptions:
    """Complete the digest of the draws; raise SpecError if there are none, or no branches."""
    return settle_along(run, options.model_copy(update={"digest": digest_of_draws(options.posterior)}))


def digest_of_draws(posterior: str) -> str:
    """Return the digest of a file of draws; raise SpecError if there is none."""
    try:
        return hashlib.sha256(_path(posterior).read_bytes()).hexdigest()
    except OSError:
        raise SpecError(
            [f"--posterior {posterior}: has no {DRAWS_FILE}; make it: magpend identify posterior DIR."]
        ) from None


def _path(posterior: str) -> Path:
    path = Path(posterior)
    return path / DRAWS_FILE if path.is_dir() else path


def drawn_parameters(run: OpenRun, options: BandOptions) -> list[list[float]]:
    """Return the packed parameters of each draw.

    Raises
    ------
    SpecError
        If the draws are of another model or do not differ along the branches.
    """
    drawn = _drawn(run, options)
    if not moving_of(drawn, options.parameter):
        raise SpecError(
            f"--posterior {options.posterior}: {options.parameter} alone was identified, and the branches run along "
            "it: nothing differs between the draws. Give --parameter another one."
        )
    run.derive("branches", parameter=options.parameter)
    packed: list[list[float]] = _packed(parameters_of(run.cube()), drawn, options.parameter).tolist()
    return packed


def _drawn(run: OpenRun, options: BandOptions) -> xr.Dataset:
    return draws_of(run, options.posterior).isel(draw=slice(options.draws or None))


def bands(run: OpenRun, options: BandOptions, packed: Sequence[Sequence[float]]) -> xr.Dataset:
    """Carry draws of the parameters through the branches of a run.

    Returns
    -------
    Dataset
        Over ``draw`` and ``bifurcation``: ``bifurcation_value`` [SI], NaN where a draw has none; with ``kind``,
        ``value`` (of the run), ``orbit_period``, ``bifurcation_section`` and ``is_border`` (whether a stable orbit
        begins or ends there). Over ``draw`` and ``orbit``: ``section`` (phase, state), the section points of each
        orbit, which `with_levels` replaces by their quantiles; over ``orbit`` the variables of `place_variables`.

    Raises
    ------
    SpecError
        If the run sweeps more than one parameter.
    """
    located = run.derive("branches", parameter=options.parameter)
    base = parameters_of(run.cube())
    along = _along(options, interval_along(run, options.parameter), base, located)
    points, states, chosen = bifurcation_data(located)
    orbits, guesses, places = orbit_data(along, located)
    data = [*points, *orbits]
    n_states = located.sizes["state"]
    guess = np.array([*states, *guesses]).reshape(len(data), n_states + 1)
    start, solved = solvable(OrbitData(along, "", tuple(data), Solution(base.pack(), guess, np.zeros_like(guess))))
    values, sections = _carry(start, np.array(packed), located.sizes["phase"])
    is_orbit = np.array([d.kind == ORBIT for d in start.data], bool)
    own = [solved[k] - len(points) for k in np.flatnonzero(is_orbit)]
    of_points = [chosen[solved[k]] for k in np.flatnonzero(~is_orbit)]
    found = _bifurcations(located, of_points, values[:, ~is_orbit])
    found = found.assign(place_variables([orbits[k] for k in own], [places[k] for k in own], np.ones(len(own))))
    found["section"] = (("draw", "orbit", "phase", "state"), sections[:, is_orbit], dict(located["section"].attrs))
    kept = {k: located.attrs[k] for k in ("parameter", "parameter_units", "model") if k in located.attrs}
    return found.assign_coords(state=located["state"]).assign_attrs(kept)


def with_levels(run: OpenRun, found: xr.Dataset, options: BandOptions) -> xr.Dataset:
    """Replace the section points of all draws by ``section_level``, their quantiles over ``level`` (`LEVELS`), and add
    the share of draws that have each orbit.
    """
    section = found["section"]
    levels = _levels(section.values, np.asarray(run.model.system.is_angle, bool))
    return (
        found.drop_vars("section")
        .assign(
            section_level=(("level", "orbit", "phase", "state"), levels, section.attrs),
            share=("orbit", np.isfinite(section.values[:, :, 0, 0]).mean(axis=0)),
        )
        .assign_coords(level=list(LEVELS))
        .assign_attrs(
            n_draws=found.sizes["draw"], identified=" ".join(moving_of(_drawn(run, options), options.parameter))
        )
    )


def draws_of(run: OpenRun, posterior: str) -> xr.Dataset:
    """Read draws of a model's parameters; raise SpecError if they are of another model."""
    with xr.open_dataset(_path(posterior), engine="scipy") as ds:
        drawn = ds.load()
    names = [str(name) for name in drawn["parameter"].values]
    own = [name for name in run.model.parameter_names if name in names]
    if len(own) != len(names):
        raise SpecError(f"--posterior {posterior}: has the parameters {', '.join(names)}: another model's.")
    return drawn


def moving_of(drawn: xr.Dataset, parameter: str) -> list[str]:
    """Return the parameters whose values differ between draws: the identified and tied ones, without the followed one.

    Along the followed parameter its own values replace the drawn ones; those of the others are carried.
    """
    moving = [*str(drawn.attrs["identified"]).split(), *str(drawn.attrs.get("tied", "")).split()]
    return [name for name in moving if name != parameter_name(parameter)]


def _along(options: BandOptions, interval: tuple[float, float], base: Parameters, located: xr.Dataset) -> Along:
    told = [str(v.attrs.get("long_name", "")) for v in located.coords.values() if v.dims == ("branch",)]
    varying = [text.removeprefix("value of ") for text in told if text.startswith("value of ")]
    frequency = np.nan if base.model.clock.hertz is None else base.model.clock.hertz
    if base.model.clock.hertz is None and axis_name(options.parameter) != FREQUENCY and FREQUENCY in located:
        rates = np.unique(located[FREQUENCY].values)
        varying += [FREQUENCY] if len(rates) > 1 else []
        frequency = float(rates[0]) if len(rates) else np.nan
    if varying:
        raise SpecError(
            [f"the run sweeps {' and '.join(varying)} besides {options.parameter}; bands need a run along one axis."]
        )
    return Along(base.model, axis_name(options.parameter), *interval, frequency)


def _packed(base: Parameters, drawn: xr.Dataset, parameter: str) -> np.ndarray:
    """Return the parameters of each draw: those of the run, with the drawn values of `moving_of`."""
    names = [str(name) for name in drawn["parameter"].values]
    values = drawn["value"].values
    packed = np.tile(base.pack(), (len(values), 1))
    for name in moving_of(drawn, parameter):
        packed[:, base.names.index(name)] = values[:, names.index(name)]
    return packed


def _carry(table: OrbitData, packed: np.ndarray, longest: int) -> tuple[np.ndarray, np.ndarray]:
    """Return for each draw and datum the value of the parameter, and the section points (phase, state); NaN where it
    is lost.
    """
    n_states = len(table.along.model.states)
    values = np.full((len(packed), len(table.data)), np.nan)
    sections = np.full((len(packed), len(table.data), longest, n_states), np.nan)
    row = 0
    for own, found in carried(table, packed):
        for points in found:
            for k, (datum, point) in enumerate(zip(table.data, points, strict=True)):
                if point is None:
                    continue
                raw = raw_of(table, datum, point)
                values[row, k] = raw[-1]
                if datum.kind == ORBIT:
                    images = np.asarray(point.value.images)[: datum.period - 1]
                    sections[row, k, : datum.period] = np.concatenate([raw[None, :-1], images])
            row += 1
        del own
    return values, sections


def _levels(sections: np.ndarray, is_angle: np.ndarray) -> np.ndarray:
    """Return quantiles of section points over the draws, (level, orbit, phase, state); angles about their mean."""
    centre = np.zeros(sections.shape[1:])
    turns = np.where(is_angle, sections, 0.0)
    with np.errstate(invalid="ignore"):
        middle = np.angle(np.nansum(np.exp(1j * turns), axis=0))
        centre = np.where(is_angle, middle, 0.0)
        away = sections - centre
        away = np.where(is_angle, np.angle(np.exp(1j * away)), away)
    found = np.full((len(LEVELS), *sections.shape[1:]), np.nan)
    known = np.isfinite(away).any(axis=0)
    if known.any():
        found[:, known] = np.nanquantile(away[:, known], LEVELS, axis=0) + centre[known]
    return found


def _bifurcations(located: xr.Dataset, chosen: list[int], values: np.ndarray) -> xr.Dataset:
    """Return the variables over ``bifurcation``: those of the run's own, and the values of the draws."""
    part = located.isel(bifurcation=chosen)
    names = ("kind", "value", "of_branch", "bifurcation_section")
    found = part[list(names)].drop_vars("state", errors="ignore")
    border = np.minimum(part["n_unstable_before"].values, part["n_unstable_after"].values) == 0
    units = {"units": located.attrs["parameter_units"]}
    return found.assign(
        bifurcation_value=(("draw", "bifurcation"), values, units),
        is_border=("bifurcation", border),
        orbit_period=("bifurcation", located["orbit_period"].values[part["of_branch"].values]),
    )


def bands_table(ds: xr.Dataset) -> Table:
    """Return a table of the bifurcations: value in the run, median and 95 % interval over the draws that have it."""
    rows: list[dict[str, Any]] = []
    words = words_of(ds["kind"]) if ds.sizes["bifurcation"] else []
    for k in np.argsort(ds["value"].values, kind="stable"):
        low, middle, high, n = interval_of(ds["bifurcation_value"].values[:, k])
        rows.append(
            {
                "label": LABELS[words[int(ds["kind"].values[k])]],
                "type": words[int(ds["kind"].values[k])],
                "period": int(ds["orbit_period"].values[k]),
                "branch": int(ds["of_branch"].values[k]),
                "value": float(ds["value"].values[k]),
                "median": middle,
                "low": low,
                "high": high,
                "n_draws": n,
                "share": n / int(ds.attrs["n_draws"]),
            }
        )
    name = parameter_name(str(ds.attrs["parameter"]))
    lines = [
        f"{len(rows)} bifurcations along {name}, carried to {ds.attrs['n_draws']} draws of {ds.attrs['identified']}"
    ]
    shown = [
        {
            name: f"{row['value']:.7g}",
            "label": row["label"],
            "type": row["type"],
            "period": str(row["period"] or "equilibrium"),
            "median": f"{row['median']:.7g}",
            "95 %": f"{row['low']:.7g} to {row['high']:.7g}",
            "draws": f"{row['n_draws']}",
            "branch": str(row["branch"]),
        }
        for row in rows
    ]
    header = ("label", "type", "period", "branch", "value", "median", "low", "high", "n_draws", "share")
    return Table(rows, [*lines, "", *aligned(shown, "")] if rows else lines, header=header)
