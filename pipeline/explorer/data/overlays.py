"""Read the results that the page draws with a diagram: curves, branches, attractors, critical shocks and edge states.

All of it is read from the cube and from ``derived/``; what no analysis has found is not there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import xarray as xr

from pipeline.analysis.branches.dataset import CRITICALITIES
from pipeline.analysis.branches.figure import pieces
from pipeline.analysis.branches.kinds import KINDS as BIFURCATIONS
from pipeline.analysis.branches.kinds import LABELS, NAMES
from pipeline.analysis.chaos.lyapunov_figure import EXPONENT_COLOURS
from pipeline.analysis.resilience.analysis import end_of
from pipeline.explorer.data.colours import rgb
from pipeline.explorer.data.explored import ExploredRun
from pipeline.explorer.data.orbits import finite, parts_of, share_bounds, shown
from pipeline.explorer.data.verticals import vertical
from pipeline.explorer.data.view import can_have
from pipeline.layout.vocabulary import (
    ATTRACTS,
    BRANCH,
    EQUILIBRIUM,
    FREQUENCY_DIM,
    KINDS,
    PERIODIC_ORBIT,
    letter,
    model_of,
)
from pipeline.plots import palette
from pipeline.plots.labels import state_measure
from pipeline.results.outcomes import outcomes, share_interval
from pipeline.results.ragged import dense, isel
from pipeline.results.tabular import sets_of
from pipeline.store.run import RunDirectory

SAME_ON_AXIS = 1e-9
"""Largest relative difference between a value of an axis and that at which branches were followed."""

MOST_SECTION = 2000
"""Section points of an attractor that are listed."""


# ---------------------------------------------------------------- curves under a diagram


def curves(run: RunDirectory, x: str, at: Mapping[str, int]) -> dict[str, Any]:
    """Return the curves of Lyapunov exponents and basin fractions along the horizontal axis of a diagram.

    Each of ``curves`` has a name, a title, a unit, a group (``exponents``, ``fractions``), a colour, ``x`` rising, and
    ``y`` with None for gaps; ``low`` and ``high`` where an interval is known.
    """
    explored = ExploredRun.open(run)
    axis, place = explored.axis(x), explored.place(at, but=x)
    found = [*_cube_exponents(explored, x, place), *_attractor_curves(explored, x, place)]
    for one in found:
        one["x"] = axis.values.tolist()
        for key in {"y", "low", "high"} & one.keys():
            one[key] = [finite(v) for v in np.asarray(one[key], np.float64)]
    return {"curves": found}


def _cube_exponents(run: ExploredRun, x: str, place: Mapping[str, int]) -> Iterator[dict[str, Any]]:
    """Yield the curves of the Lyapunov exponents: the mean over initial conditions, and the range as a band."""
    cube = run.cube()
    if "lyapunov" not in cube:
        return
    part = cube["lyapunov"].isel(place).load()
    axes = [d for d in part.dims if d not in (x, "exponent")]
    values = part.transpose(*(d for d in (x, "exponent") if d in part.dims), *axes).values
    n_others = math.prod(part.sizes[d] for d in axes)
    values = values.reshape(-1 if x in part.dims else 1, part.sizes["exponent"], max(1, n_others))
    for k in range(values.shape[1]):
        own = values[:, k]
        known = np.isfinite(own).any(axis=1)
        rows = np.where(known[:, None], own, 0.0)
        yield {
            "name": f"lyapunov{k + 1}",
            "title": f"Lyapunov exponent {k + 1}, mean over the starts",
            "unit": f"1/{run.model.clock.unit}",
            "group": "exponents",
            "colour": rgb(EXPONENT_COLOURS[k % len(EXPONENT_COLOURS)]),
            **{
                key: np.where(known, function(rows, axis=1), np.nan)
                for key, function in (("y", np.nanmean), ("low", np.nanmin), ("high", np.nanmax))
            },
        }


def _attractor_curves(run: ExploredRun, x: str, place: Mapping[str, int]) -> Iterator[dict[str, Any]]:
    """Yield the curves of each attractor's largest Lyapunov exponent and basin fraction."""
    found = run.kept("attractors")
    if found is None:
        return
    cast = palette.cast_of(found)
    part = dense(isel(found, place), ("share", "n_cells", "lyapunov_max", "kind", "stability"))
    walked = BRANCH in run.start_dims
    for number in range(part.sizes["attractor"]):
        one = part.isel(attractor=number)
        present = np.atleast_1d(one["kind"].values) > 0
        if not present.any():
            continue
        name, colour = cast.names[number], rgb(cast.colours[number])
        exponent = np.atleast_1d(one["lyapunov_max"].values)
        if np.isfinite(exponent).any():
            yield {
                "name": f"exponent {letter(number)}",
                "title": f"largest exponent of {name}",
                "unit": f"1/{run.model.clock.unit}",
                "group": "exponents",
                "colour": colour,
                "attractor": number,
                "y": exponent,
            }
        attracts = np.atleast_1d(one["stability"].values) == ATTRACTS
        if not attracts.any():
            continue
        share = np.where(attracts, np.atleast_1d(one["share"].values), np.nan)
        shares: dict[str, Any] = {"y": share}
        if not walked:  # walks are no sample of initial states: their shares have no interval
            low, high = share_interval(np.atleast_1d(one["n_cells"].values), share)
            shares |= {"low": low, "high": high}
        yield {
            "name": f"share {letter(number)}",
            "title": f"share of {name}",
            "unit": "1",
            "group": "fractions",
            "colour": colour,
            "attractor": number,
            **shares,
        }


# ---------------------------------------------------------------- branches over a diagram


def branches(run: RunDirectory, x: str, y: str, at: Mapping[str, int]) -> dict[str, Any]:
    """Return the branches of periodic orbits that are drawn over a diagram, and their bifurcations.

    ``branches`` have segments of one stability, cut where an angle wraps; ``note`` says why there is nothing. Branches
    that were followed at other values than `at` are left out; extremes have none.
    """
    explored = ExploredRun.open(run)
    place, upwards = explored.place(at, but=x), vertical(explored, y)
    explored.axis(x)
    kept = explored.kept_each("branches")
    found = next((one for one in kept if str(one.attrs["parameter"]) == x), kept[0] if kept else None)
    nothing: dict[str, Any] = {"branches": [], "points": []}
    if found is None:
        return {**nothing, "note": "not computed: magpend analyse branches DIR"}
    if str(found.attrs["parameter"]) != x:
        return {**nothing, "note": f"the branches were followed along {found.attrs['parameter']}"}
    if upwards.variable != "section":
        return {**nothing, "note": "branches have section points, and no extremes"}
    chosen = [i for i in range(found.sizes["branch"]) if _is_at(explored, found, i, place)]
    measure = state_measure(found, y)
    return {
        "branches": [
            {
                "id": i,
                "period": int(found["orbit_period"][i]),
                "motion": _motion(found, i),
                "segments": [s for piece in pieces(found, i, measure) for s in _segments(*piece)],
            }
            for i in chosen
        ],
        "points": [
            _event(found, k, y) for k in range(found.sizes["bifurcation"]) if int(found["of_branch"][k]) in chosen
        ],
        "note": None if chosen else "no branch was followed at these values of the other axes",
    }


def _is_at(run: ExploredRun, found: xr.Dataset, branch: int, place: Mapping[str, int]) -> bool:
    for name, index in place.items():
        value = float(run.axis(name).values[index])
        there = float(found[name][branch]) if name in found else _base(run, name)
        if not math.isclose(there, value, rel_tol=SAME_ON_AXIS, abs_tol=1e-300):
            return False
    return True


def _base(run: ExploredRun, axis: str) -> float:
    if axis == FREQUENCY_DIM:
        own = run.spec.frequency_hz
        return math.nan if own is None else float(own)
    return float(run.parameters[axis])


def _segments(x: np.ndarray, y: np.ndarray, stable: bool) -> Iterator[dict[str, Any]]:
    gaps = np.flatnonzero(~np.isfinite(x))
    for first, stop in zip([0, *(gaps + 1)], [*gaps, len(x)], strict=True):
        if stop - first >= 2:
            yield {"stable": bool(stable), "x": x[first:stop].tolist(), "y": y[first:stop].tolist()}


def _motion(found: xr.Dataset, branch: int) -> str | None:
    classifier = model_of(found).classifier
    if classifier is None or "side" not in found:
        return None
    codes = {int(c) for c in found["side"].values[branch]} - {0, *classifier.neutral}
    return " or ".join(classifier.words[c] for c in sorted(codes)) or None


def _event(found: xr.Dataset, k: int, y: str) -> dict[str, Any]:
    branch, kind = int(found["of_branch"][k]), BIFURCATIONS[int(found["kind"][k])]
    period = int(found["orbit_period"][branch])
    criticality = CRITICALITIES[int(found["criticality"][k])]
    values = found["bifurcation_section"].sel(state=y).values[k, : max(period, 1)]
    unstable = [int(found[f"n_unstable_{side}"][k]) for side in ("before", "after")]
    return {
        "kind": NAMES[kind],
        "x": float(found["value"][k]),
        "y": [float(v) for v in values if np.isfinite(v)],
        "label": f"{LABELS[kind]}{period or ''}",
        "branch": branch,
        "period": period,
        "criticality": criticality or None,
        "of_stable": min(unstable) == 0,
    }


# ---------------------------------------------------------------- attractors at a point


def attractors(run: RunDirectory, at: Mapping[str, int]) -> dict[str, Any]:
    """Return the attractors and other sets at a parameter point, the largest basin fraction first.

    ``cell`` is the number of a cell on each; None of an equilibrium of a flow, whose cells never meet the section.
    ``note`` says how to get them, where they are not known.
    """
    explored = ExploredRun.open(run)
    place = explored.place(at)
    found = explored.kept("attractors")
    if found is None:
        return {"attractors": [], "note": "not computed: magpend analyse attractors DIR"}
    cast = palette.cast_of(found)
    here = dense(isel(found, place), points=True)
    present = np.flatnonzero(here["kind"].values > 0).tolist()
    ids = outcomes(isel(found, place))
    listed = []
    for i in present:
        rests = int(here["kind"][i]) == EQUILIBRIUM and run.model.crossing is not None
        cell = None if rests else _cell_on(explored, ids, i, place)
        listed.append({**_set(explored, here.isel(attractor=i), i, cast), "cell": cell})
    return {"attractors": sorted(listed, key=lambda a: -(a["share"] or 0.0)), "note": None}


def _cell_on(run: ExploredRun, ids: xr.DataArray, number: int, place: Mapping[str, int]) -> int | None:
    """Return the number of the first cell on a set at a parameter point; None if no cell is on it."""
    own = np.argwhere((ids == number).values)
    return run.number({**place, **dict(zip(map(str, ids.dims), own[0].tolist(), strict=True))}) if len(own) else None


def _set(run: ExploredRun, one: xr.Dataset, number: int, cast: palette.Cast) -> dict[str, Any]:
    classifier = run.model.classifier
    side = int(one["side"]) if "side" in one else 0
    points = one["attractor_points"].transpose("point", "state").values
    points = points[np.isfinite(points).all(axis=1)][:MOST_SECTION]
    multipliers = one["multiplier_real"].values + 1j * one["multiplier_imag"].values
    closed = int(one["kind"]) == PERIODIC_ORBIT and np.isfinite(multipliers).all()
    exponent = finite(one["lyapunov_max"])
    return {
        "id": number,
        "name": cast.names[number],
        "letter": letter(number),
        **shown(one),
        "period": int(one["orbit_period"]) or None,
        "period_s": finite(one["period_s"]),
        "periods": run.model.clock.periods,
        "motion": classifier.words[side] if classifier is not None and side > 0 else None,
        "share": finite(one["share"]),
        **share_bounds(run, one),
        "n_starts": int(one["n_cells"]),
        "colour": rgb(cast.colours[number]),
        "multipliers": parts_of(multipliers) if closed else None,
        "exponents": None if exponent is None else [exponent],
        "section": points.tolist(),
    }


def disturbances(run: RunDirectory, at: Mapping[str, int]) -> dict[str, Any]:
    """Return the critical shocks of the attractors at a parameter point, and the edge states between them.

    ``shocks`` has for each attractor ``smallest`` (of the states that the analysis shocked, at any phase) and
    ``shortest`` (of all states, at the section); ``notes`` say how to get what is not stored for this point. States are
    lists in the order of the model's.
    """
    explored = ExploredRun.open(run)
    place = explored.place(at)
    shocks = next((list(_shocks(explored, one)) for one in _here(explored, "resilience", place)), None)
    edges = [edge for one in _here(explored, "edge", place) for edge in _edges(one)]
    notes = []
    if run_has_basins(explored):
        if shocks is None:
            notes.append("critical shocks are not computed here: magpend analyse resilience DIR")
        if not edges:
            point = "".join(f" --at {name}=VALUE" for name in place)
            notes.append(f"edge states are not computed here: magpend analyse edge DIR --between A B{point}")
    return {"shocks": shocks or [], "edges": edges, "notes": notes}


def run_has_basins(run: ExploredRun) -> bool:
    """Return whether shocks of a run's attractors and edge states can be computed; they need independent starts."""
    return run.remembered("has basins", lambda: can_have(run, "resilience"))


def _here(run: ExploredRun, name: str, place: Mapping[str, int]) -> Iterator[xr.Dataset]:
    """Yield the stored results of an analysis at a parameter point that name the attractors as the page does."""
    for one in run.kept_each(name):
        index = _index(run, one, place)
        if index is not None:
            yield isel(one, index).load()


def _index(run: ExploredRun, found: xr.Dataset, place: Mapping[str, int]) -> dict[str, int] | None:
    """Return the index of a parameter point in a result that may have some points only; None if it lacks it."""
    index = {}
    for name, i in place.items():
        if name not in found.coords:
            return None
        value = float(run.axis(name).values[i])
        near = [math.isclose(v, value, rel_tol=SAME_ON_AXIS, abs_tol=1e-300) for v in np.atleast_1d(found[name].values)]
        if True not in near:
            return None
        if name in found.dims:
            index[name] = near.index(True)
    return index


def _shocks(run: ExploredRun, found: xr.Dataset) -> Iterator[dict[str, Any]]:
    """Yield the critical shocks of each attractor."""
    largest = float(found.attrs["resilience_largest"])
    for _, one in sets_of(found, found["stability"].values == ATTRACTS):
        number = int(one["attractor"])
        yield {
            "attractor": number,
            "letter": letter(number),
            "largest": largest,
            "states": [name.strip() for name in str(found.attrs["resilience_states"]).split(",")],
            "smallest": _shock(run, one, "shock"),
            "shortest": _shock(run, one, "distance"),
        }


def _shock(run: ExploredRun, one: xr.Dataset, name: str) -> dict[str, Any] | None:
    """Return a critical shock; None if no shock that was tried leads away."""
    jump, before = one[name].values, one[f"{name}_from"].values
    if not (np.isfinite(jump).all() and np.isfinite(before).all()):
        return None
    phase, to = float(one[f"{name}_phase"]), int(one[f"{name}_to"])
    return {
        "low": finite(one[f"{name}_low"]),
        "high": finite(one[f"{name}_high"]),
        "phase": phase,
        # the motion of a flow from a state does not depend on the time
        "startable": phase == 0.0 or not run.model.clock.has_drive,
        "from": before.tolist(),
        "jump": jump.tolist(),
        "to": to,
        "leads_to": end_of(to),
        "n_undecided": int(one[f"{name}_n_undecided"]),
    }


def _edges(found: xr.Dataset) -> Iterator[dict[str, Any]]:
    """Yield the edge states between two attractors."""
    for i in range(found.sizes["edge"]):
        one = found.isel(edge=i)
        yield {
            "between": str(found.attrs["between_letters"]).split(),
            "kind": KINDS[int(one["kind"])].replace("_", " "),
            "period": int(one["orbit_period"]) or None,
            "n_pairs": int(one["n_pairs"]),
            "section": one["section"].values[: min(int(one["n_points"]), MOST_SECTION)].tolist(),
            "multipliers": _complex(one, "multiplier"),
            "eigenvalues": _complex(one, "eigenvalue"),
        }


def _complex(one: xr.Dataset, name: str) -> list[list[float]] | None:
    parts = np.stack([one[f"{name}_real"].values, one[f"{name}_imag"].values], axis=-1)
    return parts.tolist() if np.isfinite(parts).all() else None
