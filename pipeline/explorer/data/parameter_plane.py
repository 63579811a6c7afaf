"""Read bifurcation curves in the plane of two parameters, and integrate the orbit at a point of a curve."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.colors import to_hex

from magpend_core.models.model import Parameters
from magpend_core.orbits import section_map
from pipeline.analysis.branches.kinds import CURVE_KINDS, HOMOCLINIC, LABELS, NAMES
from pipeline.explorer import RequestError
from pipeline.explorer.data.arrays import pack_arrays
from pipeline.explorer.data.atlas import atlas
from pipeline.explorer.data.explored import ExploredRun
from pipeline.explorer.data.orbits import ORBIT_RTOL, fixed_points, orbit_series, parts_of
from pipeline.explorer.data.verticals import plain
from pipeline.layout.conventions import shown_unit
from pipeline.layout.own_words import in_own_words
from pipeline.layout.vocabulary import ATTRACTS, FREQUENCY_DIM, axis_name, frequency_of, split_dims
from pipeline.plots.labels import swept_label
from pipeline.results.ragged import ROW_SIZE, point_of_rows
from pipeline.runs.derive import options_of
from pipeline.store.run import RunDirectory

NOTHING = "no bifurcation curves: compute them with magpend analyse curves, or name their run with --curves"


def parameter_plane(run: RunDirectory) -> dict[str, Any]:
    """Return the bifurcation curves of a run, over its atlas or, if it sweeps their plane, the number of attractors.

    ``axes`` are across and upwards, ``points`` those of codimension two; ``map`` has values of both axes, the number of
    attractors at each point, and colours; ``note`` says why there are no curves. See `pipeline.explorer.data.atlas`.
    """
    explored = ExploredRun.open(run)
    found = explored.bifurcation_curves()
    if found is None:
        return {"axes": [], "curves": [], "points": [], "map": None, "atlas": None, "note": NOTHING}
    regions = atlas(explored)
    number = None if regions else _number_of_attractors(explored, found)
    found = in_own_words(found)
    names = [str(found.attrs[f"{role}_parameter"]) for role in ("first", "second")]
    return {
        "axes": [
            {"name": name, "label": _label(name, shown_unit(found[role].attrs))}
            for name, role in zip(names, ("first", "second"), strict=True)
        ],
        "curves": [_curve(found, i) for i in range(found.sizes["curve"])],
        "points": [_special(found, k) for k in range(found.sizes["special"])],
        "map": None if number is None else _map(number, names),
        "atlas": regions,
        "note": None,
    }


def _label(name: str, unit: str) -> str:
    label = swept_label(name, unit)
    return plain(label.replace("$", ""), name) if "$" in label else label


def _curve(found: xr.Dataset, i: int) -> dict[str, Any]:
    n, period = int(found["n_points"][i]), int(found["orbit_period"][i])
    return {
        "id": i,
        "kind": NAMES[CURVE_KINDS[int(found["kind"][i])]],
        "period": period,
        "x": found["first"].values[i, :n].tolist(),
        "y": found["second"].values[i, :n].tolist(),
        "pale": found["others_unstable"].values[i, :n].astype(bool).tolist() if "others_unstable" in found else None,
    }


def _special(found: xr.Dataset, k: int) -> dict[str, Any]:
    names = str(found["special_kind"].attrs["flag_meanings"]).split()
    kind = names[int(found["special_kind"][k])]
    return {
        "kind": kind.replace("_", " "),
        "label": LABELS[kind],
        "x": float(found["special_first"][k]),
        "y": float(found["special_second"][k]),
        "period": int(found["special_period"][k]),
    }


def _number_of_attractors(run: ExploredRun, found: xr.Dataset) -> xr.DataArray | None:
    """Return the number of attractors over the plane of curves; None unless the run sweeps just its two parameters."""
    attractors = run.kept("attractors")
    if attractors is None:
        return None
    swept = [d for d in map(str, split_dims(attractors["attractor_id"])[0]) if attractors.sizes[d] > 1]
    if sorted(swept) != sorted(str(found.attrs[f"{role}_parameter"]) for role in ("first", "second")):
        return None
    own = point_of_rows(attractors)[attractors["stability"].values == ATTRACTS]
    sets = attractors[ROW_SIZE]
    count = sets.copy(data=np.bincount(own, minlength=sets.size).reshape(sets.shape)).squeeze()
    return in_own_words(count.to_dataset(name="number").assign_attrs(attractors.attrs))["number"]


def _map(number: xr.DataArray, names: list[str]) -> dict[str, Any]:
    number = number.transpose(names[1], names[0]).sortby(names)
    most = int(number.max())
    shades = colormaps["cividis"](np.linspace(0.25, 1.0, max(most, 1)))
    colours = [to_hex("0.8"), *map(to_hex, shades)]
    return {
        "x": number[names[0]].values.tolist(),
        "y": number[names[1]].values.tolist(),
        "number": number.values.ravel().tolist(),
        "colours": colours,
    }


def curve_orbit(run: RunDirectory, curve: int, point: int) -> bytes:
    """Integrate the orbit at a point of a bifurcation curve; return it packed for the page.

    Raise RequestError if there is no such point, ArithmeticError if the trajectory ends early.
    """
    explored = ExploredRun.open(run)
    found = explored.bifurcation_curves()
    n_curves = 0 if found is None else found.sizes["curve"]
    if found is None or not 0 <= curve < n_curves:
        raise RequestError(f"curve = {curve} is out of bounds: there are {n_curves} curves.")
    if not int(found["orbit_period"][curve]):
        raise RequestError(f"curve {curve} has equilibria, which do not move.")
    n_points = int(found["n_points"][curve])
    if not 0 <= point < n_points:
        raise RequestError(f"point = {point} is out of bounds: the curve has points 0 to {n_points - 1}.")
    if CURVE_KINDS[int(found["kind"][curve])] == HOMOCLINIC:
        raise RequestError(f"curve {curve} has homoclinic orbits, which never return to the section.")
    source = explored if explored.curves is None else ExploredRun.open(explored.curves)
    parameters, clock_hz = _parameters_at(source, found.isel(curve=curve, point=point))
    state, period = found["section"].values[curve, point], int(found["orbit_period"][curve])
    return packed_orbit(source, parameters, clock_hz, state, period, NAMES[CURVE_KINDS[int(found["kind"][curve])]])


def packed_orbit(
    run: ExploredRun, parameters: Parameters, clock_hz: float, state: np.ndarray, period: int, kind: str
) -> bytes:
    """Integrate the orbit at a bifurcation; return it packed for the page."""
    ends = section_map(parameters.pack()[None], np.array([clock_hz]), state[None], period, system=run.model.system)
    seconds = np.cumsum(ends.times[0])
    multipliers = np.linalg.eigvals(ends.derivatives[0])
    arrays = orbit_series(parameters, clock_hz, state, period, float(seconds[-1]), rtol=ORBIT_RTOL, atol=ORBIT_RTOL)
    images = np.concatenate([state[None], ends.images[0, : period - 1]])
    arrays = {**arrays, "section": images, "section_times": np.concatenate([[0.0], seconds])}
    return pack_arrays(arrays, _attrs(run, parameters, clock_hz, period, multipliers, kind))


def _parameters_at(run: ExploredRun, one: xr.Dataset) -> tuple[Parameters, float]:
    values = {axis_name(name): float(value) for name, value in options_of(one.attrs).get("at", {}).items()}
    values |= {str(one.attrs[f"{role}_parameter"]): float(one[role]) for role in ("first", "second")}
    base = {FREQUENCY_DIM: run.spec.frequency_hz} if run.spec.frequency_hz is not None else {}
    clock = frequency_of(run.model, base | values)
    own = {name: value for name, value in values.items() if name != FREQUENCY_DIM}
    return run.parameters.replace(**own), clock


def _attrs(
    run: ExploredRun, parameters: Parameters, clock_hz: float, period: int, multipliers: np.ndarray, kind: str
) -> dict[str, Any]:
    """Return what the page shows beside the orbit at a bifurcation."""
    unknown = dict.fromkeys(
        ("cell", "at", "motion", "attractor", "share", "low", "high", "stability", "evidence", "exponents", "start")
    )
    return {
        **unknown,
        "parameters": parameters.as_dict(),
        "frequency": clock_hz if run.model.clock.hertz is None else None,
        "status": "periodic",
        "status_meaning": f"an orbit at a bifurcation: {kind}",
        "kind": f"{kind}, period {period}",
        "stable": None,
        "multipliers": parts_of(multipliers),
        "note": None,
        "exponents_from": None,
        "seeds": [],
        "fixed": fixed_points(run.model, parameters),
        "quantities": [q.name for q in run.model.quantities],
        "period": period,
        "point": 0,
        "n_periods": period,
    }
