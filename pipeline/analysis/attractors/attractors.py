"""Find the sets on which trajectories end at every parameter point, test whether they attract, and follow them along
the sweep.

    ds = pipeline.open_run(directory)
    found = identify(ds)                 # integrates: Newton's method, and samples of what has not settled
    named = match(found, threshold=0.3)  # follows orbits along the axes; repeat it with other options

The modules work on a parameter point in this order: `equilibria` and `limit_cycles` find the equilibria and the
limit cycles of flows, `searching` finds orbits, `extending` integrates the remaining cells further, and
`labelling` labels cells and describes sets. `hysteresis.find_hysteresis` finds where a continuation meets
different attractors going up and going down.

Schema
------
`identify` and `match` return a Dataset of the same form. Dims: the *parameter dims* of the cube
(``frequency`` and others, in the order of the cube; none if nothing is swept), its *start dims*
(``initial_condition``, the grid's ``<state>_0``, or ``branch``), and ``set`` (a row for each set at each
parameter point, in the order of the points), ``sample``, ``transition``, ``state``, ``multiplier``, and the
dim of the model's angles. Coordinates are those of the cube, and ``attractor`` (set), the id. `ragged` reads rows.

`pipeline.analysis.attractors.declaration` lists the variables.

`attractor_points` holds an orbit's points in the order of time, or a sample of any other set. A model
without angles, classifier, energy or symmetry lacks the variables that need it. For a polished orbit, ranges
cover the full period; angles are unwrapped from the first point, and an angle that rotates has the range -pi
to pi. For all other sets, state ranges cover the kept sections, and energy ranges the stored points.

Distances are in units of the states' scales (1 rad, 10 rad/s for the pendulum), angles on their circle;
states are in the units of the coordinate ``state_units``.
From `identify` an id numbers the sets of one parameter point (attribute ``matched`` 0), in
lexicographic order of the least section point; from `match` it follows a set (``matched`` 1), and a point
where that set is absent has no row of it. `match` adds ``match_basis`` (int8, set): the evidence for the id
there. The attribute ``n_ids`` is the number of ids. `matching` defines an id.

Each row lists a *set* on which cells end. Only a set with the stability ``attracts`` is an attractor; see
`stability` for the criteria. `decision` is 0 undecided (no id), 1 closed on the orbit, 2 certain to end on
the orbit, 3 approaching the orbit, 4 one of the set, 5 ended there when it was extended, 6 at rest (see
`equilibria`), 7 diverged when it was extended (no id), 8 grows to the end of its extension (no id;
`growth.Escape`); `assigning.decide` has the criteria. A cell that is not bounded (diverged, step limit,
pending, unreached, or without a return and yet not at rest) has the id -1 and its own `status`. A bounded
cell that belongs to no set has the id -1 and `decision` 0: it is not settled.

A run with a loose `closure_tolerance` (above 1e-4, which makes the default `tolerance` of `identify` exceed
1e-3) is short, and closure proves little: sections also recur
within a few per cent near unstable orbits, and with half the period near a period doubling. In this case a
cell is assigned to an orbit only if the orbit is polished and attracts, and the cell is near enough or
spirals in. All other cells are integrated further (`closed_orbits.run_on`) until they close within 1e-5, or stay
undecided. A loose closure alone never makes an attractor, and periods are those of polished orbits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.engine.system import System
from magpend_core.models.model import Model, Parameters
from magpend_core.precision import Precision
from pipeline.analysis.attractors.declaration import IdentifyOptions
from pipeline.analysis.attractors.features import ENERGY, Features
from pipeline.analysis.attractors.finding.equilibria import tell_rest
from pipeline.analysis.attractors.finding.limit_cycles import tell_cycles
from pipeline.analysis.attractors.finding.points import SECTION_BYTES, Dynamics, slabs
from pipeline.analysis.attractors.finding.requests import Settings
from pipeline.analysis.attractors.finding.searching import Search
from pipeline.analysis.attractors.labelling import Found, analyse, follow
from pipeline.analysis.attractors.matching import match
from pipeline.analysis.chaos.declaration import ChaosOptions
from pipeline.analysis.chaos.lyapunov import on_attractor, pooled_mean
from pipeline.layout.vocabulary import APERIODIC, ATTRACTS, DECISIONS, EVIDENCE, KINDS, STABILITIES, split_dims
from pipeline.results.ragged import N_IDS, N_POINTS, ROW_SIZE, SAMPLE, SET, TRANSITION, index_of_rows
from pipeline.results.sides import flags_of
from pipeline.results.tolerances import CELL_CLOSURE

__all__ = ["identify", "match"]


def identify(
    ds: xr.Dataset,
    options: IdentifyOptions | None = None,
    *,
    parameters: Parameters | np.ndarray | None = None,
    system: System | None = None,
    block_bytes: int = SECTION_BYTES,
    **changes: Any,
) -> xr.Dataset:
    """Find the attractors at each parameter point of a run's result cube, and assign each trajectory (cell) to one of
    them.

    Parameters
    ----------
    ds
        Cube with `section`, `status`, `orbit_period`, and `turns` if there is rotation.
    options
        By default the defaults of `IdentifyOptions`. A `tolerance` of 0 stands for ten times the attribute
        ``closure_tolerance`` of `ds`, and 1e-4 at least: a slow spiral can be eight times the closure
        tolerance away (`magpend_core.engine.observers.closed_period`). Above 1e-3 the run counts as
        loosely closed, see the text of this module. Without `polish` closed cells are grouped by distance
        alone, no spiral is recognised, and features that need integration are missing.
    parameters
        Parameters of the run, by default from `ds.attrs`. Axes of the cube replace the values of the
        same name. If `system` is given, its packed parameter vector.
    system
        By default the system of the run's model. With another system the result has no energy, mirror image
        or side.
    block_bytes
        Most memory for sections at once [bytes]; does not change the result.
    changes
        Fields of `IdentifyOptions`, used if `options` is None.

    Returns
    -------
    Dataset
        See the text of this module. It does not depend on the order or the chunks of the cells.

    Raises
    ------
    ValueError
        If a variable or the parameters are missing, or an option is out of bounds.
    """
    options = options or IdentifyOptions(**changes)
    missing = [name for name in ("section", "status", "orbit_period") if name not in ds]
    if missing:
        raise ValueError(f"The dataset has no {', '.join(missing)}; give the dataset of pipeline.open_run.")
    tolerance = options.tolerance or max(1e-4, 10.0 * float(ds.attrs.get("closure_tolerance", 1e-5)))
    dynamics = Dynamics.of(ds, parameters, system, needed=options.polish)
    settings = Settings.of(
        ds,
        dynamics.system,
        dynamics.geometry,
        closure=CELL_CLOSURE,
        longest=options.max_orbit_period,
        residual=options.residual,
    )
    search = Search(options, tolerance, dynamics, settings)
    found: dict[tuple[int, ...], Found] = {}
    with Precision.of(ds.attrs).used():
        for points in slabs(ds, dynamics, block_bytes):
            if dynamics.can_rest:
                tell_rest(points.values(), tolerance, dynamics.geometry)
            if dynamics.can_rest and not dynamics.has_returns and options.polish:
                tell_cycles(points.values(), tolerance, options.max_orbit_period, options.residual, dynamics.geometry)
            own = analyse(points, search)
            follow(own, points, search)
            found |= own
    return _with_exponents(_dataset(ds, found, search), ds)


# ---- result ------------------------------------------------------------------------------------


def _flags(words: str) -> dict[str, Any]:
    n = len(words.split())
    return {"flag_values": np.arange(n, dtype=np.int8), "flag_meanings": words}


def _dataset(ds: xr.Dataset, found: Mapping[tuple[int, ...], Found], search: Search) -> xr.Dataset:
    """Build the Dataset that `identify` returns; the docstring of this module lists its variables."""
    dims, start_dims = split_dims(ds["status"])
    shape = tuple(ds.sizes[d] for d in dims)
    result = xr.Dataset(_rows(ds, [found[at] for at in np.ndindex(*shape)], search))
    cell_dims = (*dims, *start_dims)
    cell_shape = (*shape, *(ds.sizes[d] for d in start_dims))
    growth = {name: np.full(shape, getattr(Found, name)) for name in _GROWTH}
    n_sets, ran_out = np.zeros(shape, np.int32), np.zeros(shape, np.int8)
    ids, decisions = np.empty(cell_shape, np.int32), np.empty(cell_shape, np.int8)
    for index, one in found.items():
        ids[index] = one.label.reshape(cell_shape[len(dims) :])
        decisions[index] = one.decision.reshape(cell_shape[len(dims) :])
        for name, values in growth.items():
            values[index] = getattr(one, name)
        n_sets[index], ran_out[index] = len(one.features), one.ran_out
    result[ROW_SIZE] = (dims, n_sets, {"sample_dimension": SET})
    result["ran_out"] = (dims, ran_out)
    for name, values in growth.items():
        result[name] = (dims, values)
    result["attractor_id"] = (cell_dims, ids)
    result["decision"] = (cell_dims, decisions, _flags(" ".join(DECISIONS)))
    result["status"] = (cell_dims, ds["status"].transpose(*cell_dims).values, ds["status"].attrs)
    own = {*cell_dims, "state", *result["rotation"].dims} if "rotation" in result else {*cell_dims, "state"}
    result = result.assign_coords({k: v for k, v in ds.coords.items() if set(v.dims) <= own})
    number = (SET, np.concatenate([np.arange(n, dtype=np.int32) for n in n_sets.ravel()]))
    plain = {**search.options.plain(), "tolerance": search.tolerance}
    settings = {f"identify_{k}": int(v) if isinstance(v, bool) else v for k, v in plain.items()}
    kept = {k: v for k, v in ds.attrs.items() if k != "title"}
    return result.assign_coords(attractor=number).assign_attrs(
        {**kept, **settings, "matched": 0, N_IDS: int(n_sets.max(initial=0))}
    )


_GROWTH = ("growth_rate", "growth_factor", "growth_length")


def _rows(ds: xr.Dataset, found: Sequence[Found], search: Search) -> dict[str, Any]:
    """Return the variables of the rows as (dims, values, attributes), from which xarray builds a Dataset."""
    features = [x for one in found for x in one.features]
    model, n_states = search.dynamics.model, ds.sizes["state"]
    sizes = {"state": n_states, "multiplier": n_states, "angle": search.dynamics.n_angles}
    angle_dim = model.angle_dim if model is not None else "angle"
    variables: dict[str, Any] = {}
    for name in _names(search.dynamics):
        own, dtype, fill = _TABLE[name]
        values = np.full((len(features), *(sizes[d] for d in own)), fill, dtype)
        for row, x in enumerate(features):
            known = _value(x, name)
            if known is not None:
                values[row] = known
        dims = (SET, *(angle_dim if d == "angle" else d for d in own))
        variables[name] = (dims, values, _words_of(name, model))
    variables["n_cells"][1][:] = [n for one in found for n in one.counts]
    variables["share"][1][:] = [x for one in found for x in _shares(one)]
    variables[N_POINTS][1][:] = [len(x.points) for x in features]
    variables[N_POINTS][2]["sample_dimension"] = SAMPLE
    points = np.concatenate([np.zeros((0, n_states)), *(x.points for x in features)])
    return {**variables, "attractor_points": ((SAMPLE, "state"), points), **_transitions(features)}


def _value(x: Features, name: str) -> Any:
    """Return a feature of a set by the name of its variable; None if it is not known or is not of the set alone."""
    if name in _COUNTED:
        return None
    stem, _, part = name.rpartition("_")
    if part in ("real", "imag"):
        known = x.multipliers if stem == "multiplier" else x.eigenvalues
        return None if known is None else getattr(known, part)
    return getattr(x, name)


def _shares(one: Found) -> np.ndarray:
    """Return the fraction of all trajectories that end on each attractor; 0 of a set that does not attract."""
    attracts = np.array([x.stability == ATTRACTS for x in one.features], bool)
    return np.where(attracts, np.array(one.counts, np.int64) / max(len(one.label), 1), 0.0)


def _transitions(features: Sequence[Features]) -> dict[str, Any]:
    """Return the counts of cells that left one set and ended on another, one row for each pair of sets."""
    rows = [
        (row, to, int(n))
        for row, x in enumerate(features)
        for to, n in enumerate(() if x.n_to is None else x.n_to)
        if n
    ]
    table = np.array(rows, np.int64).reshape(-1, 3)
    return {name: (TRANSITION, table[:, k]) for k, name in enumerate(("from_set", "to", "n_to"))}


def _words_of(name: str, model: Model | None) -> dict[str, Any]:
    """Return further attributes of a variable: the meanings of its codes, or the unit of the energy."""
    known = {"kind": KINDS, "stability": STABILITIES, "evidence": EVIDENCE}
    if name in known:
        return _flags(" ".join(known[name]))
    if name == "side" and model is not None and model.classifier is not None:
        return flags_of(model.classifier)
    if name.startswith("energy_") and model is not None:
        end = "least" if name == "energy_min" else "largest"
        return {"units": model.quantity(ENERGY).unit, "long_name": f"{end} energy"}
    return {}


def _with_exponents(result: xr.Dataset, ds: xr.Dataset) -> xr.Dataset:
    """Set the largest Lyapunov exponent of each non-periodic set, from the stored exponents of its trajectories."""
    if "lyapunov" not in ds:
        return result
    dims, signs = result["attractor_id"].dims, ChaosOptions()
    first = ds[["lyapunov", "lyapunov_stderr"]].isel(exponent=0, drop=True).transpose(*dims)
    rate, error = first["lyapunov"].values, first["lyapunov_stderr"].values
    counts = on_attractor(ds, n_sigma=signs.n_sigma, least=signs.least).transpose(*dims).values
    ids, kind, number = result["attractor_id"].values, result["kind"].values, result["attractor"].values
    points = np.array(index_of_rows(result), np.int64).reshape(result[ROW_SIZE].ndim, result.sizes[SET]).T
    for row in np.flatnonzero(np.isin(kind, APERIODIC)).tolist():
        point = tuple(points[row].tolist())
        which = (ids[point] == number[row]) & counts[point]
        if which.any():
            # sum in rising order, so that the last bit does not depend on the order of the cells
            order = np.argsort(rate[point][which], kind="stable")
            own, errors = rate[point][which][order], error[point][which][order]
            _, stderr, _ = pooled_mean(own[None], errors[None], np.ones((1, own.size), bool))
            for end, sign in (("max", 0.0), ("low", -signs.n_sigma), ("high", signs.n_sigma)):
                result[f"lyapunov_{end}"].values[row] = own.mean() + sign * stderr[0]
    return result


_TABLE: dict[str, tuple[tuple[str, ...], str, float]] = {
    "kind": ((), "int8", 0),
    "stability": ((), "int8", 0),
    "evidence": ((), "int8", 0),
    "orbit_period": ((), "int32", 0),
    "n_cells": ((), "int64", 0),
    "share": ((), "float64", 0.0),
    N_POINTS: ((), "int32", 0),
    "rotation": (("angle",), "float64", np.nan),
    "side": ((), "int8", 0),
    "state_min": (("state",), "float64", np.nan),
    "state_max": (("state",), "float64", np.nan),
    "energy_min": ((), "float64", np.nan),
    "energy_max": ((), "float64", np.nan),
    "mirror_partner": ((), "int32", -1),
    "mirror_distance": ((), "float64", np.nan),
    "multiplier_real": (("multiplier",), "float64", np.nan),
    "multiplier_imag": (("multiplier",), "float64", np.nan),
    "residual": ((), "float64", np.nan),
    "multiplier_error": ((), "float64", np.nan),
    "is_polished": ((), "int8", 0),
    "lyapunov_max": ((), "float64", np.nan),
    "lyapunov_low": ((), "float64", np.nan),
    "lyapunov_high": ((), "float64", np.nan),
    "period_s": ((), "float64", np.nan),
    "eigenvalue_real": (("multiplier",), "float64", np.nan),
    "eigenvalue_imag": (("multiplier",), "float64", np.nan),
    "n_sampled": ((), "int64", 0),
    "n_left": ((), "int64", 0),
    "n_leaving": ((), "int64", 0),
    "time_at_risk": ((), "float64", np.nan),
    "mean_lifetime": ((), "float64", np.nan),
    "lifetime_low": ((), "float64", np.nan),
    "lifetime_high": ((), "float64", np.nan),
    "dimension": ((), "int8", 0),
    "closes_above": ((), "int32", 0),
}
"""Own dims, dtype, fill, units and long name of the variables per attractor."""

_COUNTED = ("n_cells", "share", N_POINTS)
"""Variables that are not an attribute of `Features`."""


def _names(dynamics: Dynamics) -> list[str]:
    model = dynamics.model
    has_energy = model is not None and any(q.name == ENERGY for q in model.quantities)
    left_out = {
        "energy_": not has_energy,
        "mirror_": model is None or model.mirror is None,
        "side": model is None or model.classifier is None,
        "rotation": not dynamics.n_angles,
        "eigenvalue_": model is None or not model.clock.has_equilibria,
    }
    return [name for name in _TABLE if not any(name.startswith(k) and out for k, out in left_out.items())]
