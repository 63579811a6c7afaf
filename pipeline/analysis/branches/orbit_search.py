"""Define the analysis ``orbits`` of a run: a search for all periodic orbits at one parameter point."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.engine.system import System
from pipeline.analysis.branches.asked import start_problems
from pipeline.analysis.branches.declaration import OrbitOptions
from pipeline.analysis.branches.deflation import (
    DeflationSettings,
    FoundOrbit,
    coverage,
    expected_index,
    index_sums,
    orbit_near,
    place_of,
    search_orbits,
    starts_around,
)
from pipeline.analysis.branches.starting_orbits import parameters_at, sections_of
from pipeline.layout.vocabulary import model_attribute, model_of, parameters_of, section_attributes, split_dims
from pipeline.products.product import Table
from pipeline.results.run import OpenRun
from pipeline.results.selection import select_points
from pipeline.results.tabular import Row, Words, aligned, counted, state_columns
from pipeline.specification.problems import SpecError


def needs_point(run: OpenRun, options: OrbitOptions) -> None:
    """Refuse options that choose no parameter point or several, and a --start without all states or a period."""
    point_of(run.cube(), options)
    problems = start_problems(run.model, options)
    if options.start and not options.start_period:
        problems.append("--start-period 0: this analysis takes orbits; give their period, 1 or more.")
    if problems:
        raise SpecError(problems)


def point_of(cube: xr.Dataset, options: OrbitOptions) -> xr.Dataset:
    """Return the part of a run's result cube at the one parameter point that the options choose."""
    part = select_points(cube, options.at, purpose="orbits are searched at one parameter point")
    return part.isel(dict.fromkeys(split_dims(part["status"])[0], 0))


def orbits(run: OpenRun, options: OrbitOptions) -> xr.Dataset:
    """Search for all periodic orbits, stable or not, up to a given period at one parameter point, and for that near
    --start.
    """
    cube = run.cube()
    point, base = point_of(cube, options), parameters_of(cube)
    frequency, packed = parameters_at(point, base)
    system = base.model.system
    starts = starts_around(sections_of(point), options.starts, options.seed, system)
    periods = np.arange(1, options.max_period + 1)
    found = search_orbits(
        np.tile(starts, (len(periods), 1)),
        np.repeat(periods, len(starts)),
        frequency,
        packed,
        system,
        settings=DeflationSettings(rounds=options.rounds),
    )
    asked = None
    if options.start:
        state = np.array([options.start[name] for name in system.state_names])
        asked = orbit_near(state, options.start_period, frequency, packed, system)
    if asked is not None and place_of(found, asked.points, system) < 0:
        found.append(replace(asked, n_hits=0))  # no random start led to it
    place = -1 if asked is None else place_of(found, asked.points, system)
    return _dataset(found, system, options, point).assign_attrs({"start_orbit": place} if options.start else {})


def _dataset(found: list[FoundOrbit], system: System, options: OrbitOptions, point: xr.Dataset) -> xr.Dataset:
    model = model_of(point)
    section = np.full((len(found), max([options.max_period, *(o.period for o in found)]), system.n_states), np.nan)
    multipliers = np.full((len(found), system.n_states), np.nan, np.complex128)
    for i, one in enumerate(found):
        section[i, : one.period] = one.points
        multipliers[i] = one.multipliers
    sums = index_sums(found, options.max_period)

    def column(values: Any) -> tuple[str, Any]:
        return "orbit", np.asarray(values, np.int32)

    expected = {} if model.crossing is not None else {"expected_index_sum": expected_index(system)}
    return xr.Dataset(
        {
            "section": (("orbit", "phase", "state"), section),
            "orbit_period": column([one.period for one in found]),
            "period_s": ("orbit", [one.seconds for one in found]),
            "n_unstable": column((np.abs(multipliers) > 1.0).sum(axis=1)),
            "n_hits": column([one.n_hits for one in found]),
            "search_round": column([one.search_round for one in found]),
            "index": column([one.index() for one in found]),
            "multiplier_real": (("orbit", "multiplier"), multipliers.real),
            "multiplier_imag": (("orbit", "multiplier"), multipliers.imag),
            "index_sum": ("times", np.array(list(sums.values()), np.int32)),
        },
        coords={"state": list(system.state_names), "times": list(sums)},
        attrs={
            "model": model_attribute(model),
            **section_attributes(model.crossing),
            **expected,
            "n_starts": options.starts,
            "coverage": coverage(found),
        },
    )


def orbits_table(ds: xr.Dataset) -> Table:
    """Return the table of the orbits found, with text lines on whether orbits may be missing."""
    model = model_of(ds)
    at_rest = bool(model.clock.n_neutral)  # at instants, a flow's fixed points are equilibria
    rows = [_row(ds.isel(orbit=i), at_rest, model.crossing is not None) for i in range(ds.sizes["orbit"])]
    found = counted(len(rows), "fixed point" if at_rest else "orbit")
    lines = [f"{found} from {counted(int(ds.attrs['n_starts']), 'start')} per period", ""]
    if at_rest:
        lines[1:1] = ["at instants a flow's fixed points are its equilibria, of period 0; its orbits need a [section]"]
    lines += [*aligned([_words(row) for row in rows], ""), ""]
    if "start_orbit" in ds.attrs:
        lines.append(_start_line(rows, int(ds.attrs["start_orbit"])))
    if np.isfinite(ds.attrs["coverage"]):
        lines.append(f"coverage: {100.0 * ds.attrs['coverage']:.1f} % of the starts lead to one of them (estimate)")
    if "expected_index_sum" in ds.attrs:
        lines += _index_lines(ds, int(ds.attrs["expected_index_sum"]))
    return Table(rows, lines, "" if rows else "no periodic orbit was found; try more --starts.")


def _start_line(rows: list[Row], place: int) -> str:
    if place < 0:
        return "--start: Newton's method found no orbit from there; try another state, or another --start-period"
    return f"--start: leads to orbit {place + 1} of the table, of period {rows[place]['period']}"


def _index_lines(ds: xr.Dataset, expected: int) -> list[str]:
    sums = {int(p): int(total) for p, total in zip(ds["times"].values, ds["index_sum"].values, strict=True)}
    wrong = [f"{p}: {total}" for p, total in sums.items() if total != expected]
    if not wrong:
        return [f"the indices add up to {expected} for every period, as they do if no orbit is missing"]
    return [
        f"the indices should add up to {expected} if all trajectories stay bounded; orbits are missing of periods "
        f"(index sum) {', '.join(wrong)}: try more --starts"
    ]


def _row(one: xr.Dataset, at_rest: bool, is_crossing: bool) -> Row:
    values = one["multiplier_real"].values + 1j * one["multiplier_imag"].values
    columns = state_columns(map(str, one["state"].values), [*_COLUMNS, "unstable", "multiplier", "hits", "seconds"])
    return {
        "period": 0 if at_rest else int(one["orbit_period"]),
        **({"period_s": float(one["period_s"])} if is_crossing else {}),
        "n_unstable": int(one["n_unstable"]),
        "multiplier_real": float(values[0].real),
        "multiplier_imag": float(values[0].imag),
        **dict(zip(columns.values(), one["section"].values[0].tolist(), strict=True)),
        "n_hits": int(one["n_hits"]),
        "index": int(one["index"]),
    }


def _words(row: Row) -> Words:
    largest = complex(row["multiplier_real"], row["multiplier_imag"])
    states = [name for name in row if name not in _COLUMNS]
    return {
        "period": str(row["period"]),
        **({"seconds": f"{row['period_s']:.6g}"} if "period_s" in row else {}),
        "unstable": str(row["n_unstable"]),
        "multiplier": f"{largest.real:.5g}" + (f"{largest.imag:+.5g}i" if largest.imag else ""),
        **{name: f"{row[name]:.6f}" for name in states},
        "hits": str(row["n_hits"]),
        "index": str(row["index"]),
    }


_COLUMNS = ("period", "period_s", "n_unstable", "multiplier_real", "multiplier_imag", "n_hits", "index")
