"""Track the edge states between two attractors of a run, as an analysis (`pipeline.analysis.resilience.declaration`).

The Dataset has the dims ``edge`` (different edge states), ``point``, ``state``, ``multiplier``, ``pair`` (tracked
pairs) and ``step`` (sections of their paths).

`pipeline.analysis.resilience.declaration` lists the variables.

The attribute ``between`` has the ids of the two attractors, and ``between_letters`` their letters.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from magpend_core.troubleshooting import see
from pipeline.analysis.attractors.destinations import Destinations, destinations_at
from pipeline.analysis.attractors.extension.clouds import group
from pipeline.analysis.attractors.finding.closed_orbits import Orbit, number_of
from pipeline.analysis.attractors.finding.known_sets import Equilibrium
from pipeline.analysis.attractors.finding.points import SECTION_BYTES, Dynamics, slabs
from pipeline.analysis.basins.analysis import check_starts
from pipeline.analysis.resilience.declaration import EdgeOptions
from pipeline.analysis.resilience.edge_tracking import REASONS, Pair, Tracking, nearest_pairs, orbits_on
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import (
    ATTRACTS,
    BOUNDED_SET,
    EQUILIBRIUM,
    KINDS,
    PERIODIC_ORBIT,
    letter,
    section_attributes,
    split_dims,
    told_by,
)
from pipeline.products.product import Table
from pipeline.results.outcomes import outcomes
from pipeline.results.ragged import padded
from pipeline.results.run import OpenRun
from pipeline.results.selection import refuse_origins, select_points, start_states
from pipeline.results.sets import Geometry
from pipeline.results.tabular import Row, Words, aligned, counted, plain, words_of
from pipeline.results.tolerances import SAME_EQUILIBRIUM

PURPOSE = "edge states are tracked at one parameter point"


def needs_pair(run: OpenRun, options: EdgeOptions) -> None:
    """Raise ValueError unless the run has independent initial states and the options choose a parameter point."""
    cube = run.cube()
    check_starts(cube)
    refuse_origins(cube, "the search of edge states")
    select_points(cube, options.at, purpose=PURPOSE)
    first, second = _letters(options.between)
    if first == second:
        raise ValueError(f"--between {' '.join(options.between)}: give two different attractors.")
    if not options.closest < options.farthest:
        raise ValueError(
            f"--closest {options.closest:g} must be less than --farthest {options.farthest:g}: a pair is bisected "
            "down to the first distance when it exceeds the second."
        )


def settle_edge(run: OpenRun, options: EdgeOptions) -> EdgeOptions:
    """Replace ids of attractors by their letters, in rising order."""
    first, second = sorted(_letters(options.between), key=lambda name: (len(name), name))
    return options.model_copy(update={"between": (first, second)})


def _letters(names: tuple[str, str]) -> list[str]:
    """Return the letters of attractors that are named by letters or ids."""
    return [letter(int(name)) if name.isdigit() else name for name in (n.strip().upper() for n in names)]


def edge(run: OpenRun, options: EdgeOptions) -> xr.Dataset:
    """Track the edge states between two attractors at a parameter point."""
    each = 4  # pairs that are bisected for each that is tracked: between some of them a third basin lies
    whole = run.derive("attractors")
    cube, attractors = (select_points(ds, options.at, purpose=PURPOSE) for ds in (run.cube(), whole))
    dims, starts = split_dims(attractors["attractor_id"])
    here = attractors.isel(dict.fromkeys(dims, 0))
    between = ids_of(here, options.between)
    (points,) = slabs(cube, Dynamics.of(cube), SECTION_BYTES)
    ((_, there),) = destinations_at(cube, attractors, points)
    untold = [name for name, number in zip(options.between, between, strict=True) if number not in there.told]
    if untold:
        raise ValueError(f"trajectories cannot be told to end on attractor {untold[0]}; track between two others.")
    labels = outcomes(here).transpose(*starts).values.ravel()
    candidates = nearest_pairs(start_states(cube, starts), labels, between, each * options.pairs, there, options)
    tracking = Tracking(there, between, options)
    pairs = tracking.choose(candidates, options.pairs)
    tracking.run(pairs)
    settled = all(isinstance(pair.found, Orbit | Equilibrium) for pair in pairs)
    paths = [np.array(pair.path) for pair in pairs if len(pair.path) > options.max_period]
    on_paths = [] if settled else orbits_on(paths, there, between, options.max_period)
    attrs = {**told_by(here.attrs), **section_attributes(run.model.crossing), "title": "edge states"}
    attrs |= {"between": list(between), "between_letters": " ".join(map(letter, between))}
    return _dataset(there, pairs, on_paths, here).assign_attrs(attrs)


def ids_of(here: xr.Dataset, names: tuple[str, str]) -> tuple[int, int]:
    """Return the ids of two attractors from their letters; raise ValueError if the point has no such attractors, or if
    one of them is a limit cycle that is seen at even times.
    """
    known = {letter(i): i for i in np.flatnonzero(here["stability"].values == ATTRACTS).tolist()}
    for name in names:
        if name not in known:
            raise ValueError(
                f"attractor {name} is not at the parameter point; it has {', '.join(known) or 'none'} "
                "(magpend analyse attractors)."
            )
        if here["kind"].values[known[name]] == PERIODIC_ORBIT and not here["orbit_period"].values[known[name]]:
            raise ValueError(
                f"--between {' '.join(names)}: attractor {name} is a limit cycle seen at even times, and edge needs "
                "its crossings to tell what ends on it. Give a new run a table [section], with of, value and direction."
            )
    return known[names[0]], known[names[1]]


def _distinct(pairs: list[Pair], geometry: Geometry, least: float) -> tuple[list[Any], list[int]]:
    """Return the different edge states, and the number of that of each pair, -1 for none."""
    orbits: list[Orbit] = []
    rests: list[Equilibrium] = []
    sets = [pair.found for pair in pairs if isinstance(pair.found, np.ndarray)]
    numbers = iter(group(sets, geometry, least)[0].tolist() if sets else [])
    keys: list[tuple[str, int] | None] = []
    for pair in pairs:
        one = pair.found
        if isinstance(one, Orbit):
            k = number_of(one, orbits, geometry)
            orbits += [one] * (k == len(orbits))
            keys.append(("orbit", k))
        elif isinstance(one, Equilibrium):
            near = [k for k, r in enumerate(rests) if geometry.distance(r.state, one.state) <= SAME_EQUILIBRIUM]
            rests += [one] * (not near)
            keys.append(("rest", near[0] if near else len(rests) - 1))
        else:
            keys.append(None if one is None else ("set", next(numbers)))
    order = sorted({key for key in keys if key is not None})
    found = [next(pair.found for pair, key in zip(pairs, keys, strict=True) if key == wanted) for wanted in order]
    return found, [order.index(key) if key is not None else -1 for key in keys]


def _dataset(there: Destinations, pairs: list[Pair], on_paths: list[Orbit], here: xr.Dataset) -> xr.Dataset:
    found, edge_of = _distinct(pairs, there.geometry, there.settings.closure)
    tracked = [one for one in found if isinstance(one, Orbit)]
    found += [one for one in on_paths if number_of(one, tracked, there.geometry) == len(tracked)]
    n = there.geometry.n_states
    points = [_points_of(one) for one in found]
    paths = [np.array(pair.path).reshape(-1, n) for pair in pairs]
    initial = np.array([pair.start for pair in pairs]).reshape(len(pairs), 2, -1)
    variables = {
        "section": (("edge", "point", "state"), padded(points, n)),
        "n_points": ("edge", np.array([len(p) for p in points], np.int32)),
        **_about(found, n),
        "n_pairs": ("edge", np.bincount([k for k in edge_of if k >= 0], minlength=len(found))),
        "pair_edge": ("pair", np.array(edge_of, np.int32)),
        "pair_reason": ("pair", np.array([p.reason for p in pairs], np.int8), code_flags(REASONS)),
        "pair_start": (("pair", "side", "state"), initial),
        "path": (("pair", "step", "state"), padded(paths, n)),
        "n_steps": ("pair", np.array([len(p) for p in paths], np.int32)),
    }
    scalars = {str(k): v.variable for k, v in here.coords.items() if not v.ndim}
    states = {name: here[name].variable for name in ("state", "state_units") if name in here.coords}
    return xr.Dataset(variables).assign_coords({**scalars, **states})


def _points_of(one: Orbit | Equilibrium | np.ndarray) -> np.ndarray:
    if isinstance(one, Orbit):
        return one.points
    return one.state[None] if isinstance(one, Equilibrium) else one


def _about(found: list[Any], n_states: int) -> dict[str, Any]:
    """Return the variables of the edge states that are numbers: kind, period, multipliers, eigenvalues, residual."""
    none = np.full(n_states, np.nan + 0.0j)
    rows: list[tuple[Any, ...]] = []
    for one in found:
        if isinstance(one, Orbit):
            rows.append((PERIODIC_ORBIT, one.period, one.seconds, one.residual, one.multipliers, none))
        elif isinstance(one, Equilibrium):
            rows.append((EQUILIBRIUM, 0, np.nan, one.residual, none, one.eigenvalues))
        else:
            rows.append((BOUNDED_SET, 0, np.nan, np.nan, none, none))
    kinds, periods, seconds, residuals, multipliers, eigenvalues = zip(*rows, strict=True) if rows else ((),) * 6
    variables: dict[str, Any] = {
        "kind": ("edge", np.array(kinds, np.int8), code_flags(KINDS)),
        "orbit_period": ("edge", np.array(periods, np.int32)),
        "period_s": ("edge", np.array(seconds, float)),
        "residual": ("edge", np.array(residuals, float)),
    }
    for name, values in (("multiplier", multipliers), ("eigenvalue", eigenvalues)):
        both = np.array(values, complex).reshape(len(found), n_states)
        for part, numbers in (("real", both.real), ("imag", both.imag)):
            variables[f"{name}_{part}"] = (("edge", "multiplier"), numbers)
    return variables


def edge_table(ds: xr.Dataset) -> Table:
    """Return a row per section point of each edge state; print a line per edge state, and one per reason for none."""
    letters = str(ds.attrs["between_letters"])
    n_pairs, found = ds.sizes["pair"], int((ds["pair_edge"] >= 0).sum())
    head = f"between {letters.replace(' ', ' and ')}: {counted(ds.sizes['edge'], 'edge state')}"
    lines = [f"{head}, from {found} of {counted(n_pairs, 'pair')}"]
    lines += aligned([_words(ds.isel(edge=i)) for i in range(ds.sizes["edge"])])
    reasons = ds["pair_reason"].values
    for code in np.unique(reasons[reasons > 0]).tolist():
        n = counted(int((reasons == code).sum()), "pair")
        lines.append(f"  not decided, {n}: {_SENTENCES[REASONS[code]]} {see('not-decided')}")
    nothing = "" if n_pairs else f"no cells end on both of {letters}; grow the run, or choose two others."
    return Table(_rows(ds), lines, nothing)


_SENTENCES = {
    "third_attractor": "another basin lies between the two; start closer to their common boundary with a finer grid",
    "undecided": "states between the two end on no known attractor; a larger --budget may decide",
    "lost": "the pair diverged, did not return to the section, or left the boundary; a smaller --farthest may help",
    "parted": "it parts too far within one section to show where the boundary is; a smaller --closest may help",
    "not_settled": "its path has not come to a set that repeats itself; give more --returns",
}


def _rows(ds: xr.Dataset) -> list[Row]:
    names, rows = ds["state"].values.tolist(), []
    for i in range(ds.sizes["edge"]):
        one = ds.isel(edge=i)
        head = {"edge": i, "between": str(ds.attrs["between_letters"]), **_numbers(one)}
        for k, point in enumerate(one["section"].values[: int(one["n_points"])].tolist()):
            rows.append({**head, "point": k, **dict(zip(names, point, strict=True))})
    return rows


def _numbers(one: xr.Dataset) -> Row:
    row: Row = {
        "kind": words_of(one["kind"])[int(one["kind"])],
        "period": int(one["orbit_period"]),
        "n_pairs": int(one["n_pairs"]),
        "residual": float(one["residual"]),
    }
    for name in ("multiplier", "eigenvalue"):
        for k in range(one.sizes["multiplier"]):
            row |= {f"{name}{k + 1}_{part}": float(one[f"{name}_{part}"][k]) for part in ("real", "imag")}
    return row


def _words(one: xr.Dataset) -> Words:
    kind = int(one["kind"])
    name = {PERIODIC_ORBIT: "multipliers", EQUILIBRIUM: "eigenvalues [1/s]"}.get(kind)
    values = "" if name is None else ", ".join(_complex(one, "multiplier" if kind == PERIODIC_ORBIT else "eigenvalue"))
    point = ", ".join(f"{value:.9g}" for value in one["section"].values[0])
    return {
        "kind": plain(words_of(one["kind"])[kind]),
        "period": str(int(one["orbit_period"])) if kind == PERIODIC_ORBIT else "-",
        "found by": counted(int(one["n_pairs"]), "pair") if int(one["n_pairs"]) else "on a path",
        "first section point": point if kind != EQUILIBRIUM else f"at {point}",
        name or "multipliers": values or "-",
    }


def _complex(one: xr.Dataset, name: str) -> list[str]:
    real, imag = one[f"{name}_real"].values, one[f"{name}_imag"].values
    return [f"{a:.6g}" if abs(b) <= 1e-9 * abs(a) else f"{a:.6g}{b:+.6g}i" for a, b in zip(real, imag, strict=True)]
