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

======================== ===================================== ============ ==================================
variable                 dims                                  dtype, fill  meaning
======================== ===================================== ============ ==================================
``attractor_id``         parameter dims, start dims            int32, -1    which set; -1: see `status`
``decision``             parameter dims, start dims            int8, 0      how it was decided, see below
``status``               parameter dims, start dims            int8         as in the cube
``ran_out``              parameter dims                        int8, 0      1 if the budget of the extension
                                                                            ended before all was decided
``growth_rate``          parameter dims                        float64, NaN of cells that grow: relative growth of
``growth_factor``                                              float64, NaN their distance from where they began, at
``growth_length``                                              int64, 0     the end [1/s], its factor, and sections
``kind``                 set                                   int8, 0      `vocabulary.KINDS`
``stability``            set                                   int8, 0      `vocabulary.STABILITIES`
``evidence``             set                                   int8, 0      evidence for the stability:
                                                                            `vocabulary.EVIDENCE`
``orbit_period``         set                                   int32, 0     drive periods; 0 if not periodic
``n_cells``              set                                   int64, 0     cells
``share``                set                                   float64, 0   of all cells of the point; 0 of a set
                                                                            that does not attract
``n_sets``               parameter dims                        int32        rows of the point
``attractor_points``     sample, state                         float64      section points, row after row
``n_points``             set                                   int32        section points of the row
``rotation``             set, angle                            float64, NaN mean turns per drive period
``side``                 set                                   int8, 0      codes of the model's classifier
``state_min``,           set, state                            float64, NaN range, below
``state_max``
``energy_min``,          set                                   float64, NaN range of the model's energy, below
``energy_max``
``mirror_partner``       set                                   int32, -1    set that is its image
``mirror_distance``      set                                   float64, NaN nearest set to the image
``multiplier_real``,     set, multiplier                       float64, NaN Floquet multipliers over the
``multiplier_imag``                                                         orbit's period, by falling modulus
``multiplier_error``     set                                   float64, NaN error of the largest modulus
``residual``             set                                   float64, NaN certificate of Newton's method
``is_polished``          set                                   int8, 0      1 if Newton's method converged
``lyapunov_max``,        set                                   float64, NaN largest exponent [1/s], and its
``lyapunov_low``,                                                           interval of 3 standard errors
``lyapunov_high``
``period_s``             set                                   float64, NaN period of a polished orbit [s]
``eigenvalue_real``,     set, multiplier                       float64, NaN of an equilibrium [1/s], by
``eigenvalue_imag``                                                         falling real part
``n_sampled``            set                                   int64, 0     its cells that were extended, and
                                                                            neighbours of them
``n_left``               set                                   int64, 0     extended cells that left it
``n_leaving``            set                                   int64, 0     extended cells near their end
                                                                            from the start
``n_to``, ``from_set``,  transition                            int64        cells that left, the row that they
``to``                                                                      left, the id of the set of their end
``time_at_risk``         set                                   float64, NaN sum over cells [drive periods]
``mean_lifetime``,       set                                   float64, NaN lifetime and its interval, or its
``lifetime_low``,                                                           lower bound and infinity [drive
``lifetime_high``                                                           periods]; see `intervals`
``dimension``            set                                   int8, 0      of a torus; 0 of any other set
``closes_above``         set                                   int32, 0     period that cells seem to close
                                                                            with, above the longest looked for
======================== ===================================== ============ ==================================

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
from pipeline.analysis.attractors.features import ENERGY, Features
from pipeline.analysis.attractors.finding.equilibria import tell_rest
from pipeline.analysis.attractors.finding.limit_cycles import tell_cycles
from pipeline.analysis.attractors.finding.points import BUDGET, Dynamics, slabs
from pipeline.analysis.attractors.finding.requests import Settings, answer_all
from pipeline.analysis.attractors.finding.searching import Search
from pipeline.analysis.attractors.labelling import Found, analyse, follow
from pipeline.analysis.attractors.matching import match
from pipeline.analysis.chaos.lyapunov import on_attractor, pooled_mean
from pipeline.analysis.ragged import N_IDS, N_POINTS, ROW_SIZE, SAMPLE, SET, TRANSITION, index_of_rows
from pipeline.analysis.sides import flags_of
from pipeline.analysis.tolerances import CLOSURE
from pipeline.layout.vocabulary import APERIODIC, ATTRACTS, DECISIONS, EVIDENCE, KINDS, STABILITIES, split_dims
from pipeline.products.attractors import IdentifyOptions
from pipeline.products.chaos import ChaosOptions

__all__ = ["identify", "match"]


def identify(
    ds: xr.Dataset,
    options: IdentifyOptions | None = None,
    *,
    parameters: Parameters | np.ndarray | None = None,
    system: System | None = None,
    block_bytes: int = BUDGET,
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
        closure=CLOSURE,
        longest=options.max_orbit_period,
        residual=options.residual,
    )
    search = Search(options, tolerance, dynamics, settings)
    found: dict[tuple[int, ...], Found] = {}
    with Precision.of(ds.attrs).used():
        for points in slabs(ds, dynamics, block_bytes):
            if dynamics.can_rest:
                tell_rest(points.values(), tolerance, dynamics.geometry)
            if dynamics.can_rest and not dynamics.is_flow and options.polish:
                tell_cycles(points.values(), tolerance, options.max_orbit_period, options.residual, dynamics.geometry)
            works = {index: analyse(point, search) for index, point in points.items()}
            own = answer_all(works, points, settings)
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
    result[ROW_SIZE] = (dims, n_sets, {"units": "1", "long_name": "number of sets", "sample_dimension": SET})
    result["ran_out"] = (dims, ran_out, {"units": "1", "long_name": "whether the extension's budget ended"})
    for name, (units, text) in _GROWTH.items():
        result[name] = (dims, growth[name], {"units": units, "long_name": text})
    result["attractor_id"] = (cell_dims, ids, {"units": "1", "long_name": "attractor of the cell, -1 none"})
    how = {"units": "1", "long_name": "how the cell was decided", **_flags(" ".join(DECISIONS))}
    result["decision"] = (cell_dims, decisions, how)
    about = {"units": "1", "long_name": "what became of the cell", **ds["status"].attrs}
    result["status"] = (cell_dims, ds["status"].transpose(*cell_dims).values, about)
    own = {*cell_dims, "state", *result["rotation"].dims} if "rotation" in result else {*cell_dims, "state"}
    result = result.assign_coords({k: v for k, v in ds.coords.items() if set(v.dims) <= own})
    number = (SET, np.concatenate([np.arange(n, dtype=np.int32) for n in n_sets.ravel()]), _ID)
    plain = {**search.options.plain(), "tolerance": search.tolerance}
    settings = {f"identify_{k}": int(v) if isinstance(v, bool) else v for k, v in plain.items()}
    kept = {k: v for k, v in ds.attrs.items() if k != "title"}
    return result.assign_coords(attractor=number).assign_attrs(
        {**kept, **settings, "matched": 0, N_IDS: int(n_sets.max(initial=0))}
    )


_GROWTH = {
    "growth_rate": ("1/s", "relative growth of cells that grow, at the end of their extension"),
    "growth_factor": ("1", "factor by which their distance from where they began grew"),
    "growth_length": ("1", "sections over which it grew"),
}

_ID = {"units": "1", "long_name": "attractor"}


def _rows(ds: xr.Dataset, found: Sequence[Found], search: Search) -> dict[str, Any]:
    """Return the variables of the rows as (dims, values, attributes), from which xarray builds a Dataset."""
    features = [x for one in found for x in one.features]
    model, n_states = search.dynamics.model, ds.sizes["state"]
    sizes = {"state": n_states, "multiplier": n_states, "angle": search.dynamics.n_angles}
    angle_dim = model.angle_dim if model is not None else "angle"
    variables: dict[str, Any] = {}
    for name in _names(search.dynamics):
        own, dtype, fill, units, text = _TABLE[name]
        values = np.full((len(features), *(sizes[d] for d in own)), fill, dtype)
        for row, x in enumerate(features):
            known = _value(x, name)
            if known is not None:
                values[row] = known
        dims = (SET, *(angle_dim if d == "angle" else d for d in own))
        variables[name] = (dims, values, {"units": units, "long_name": text, **_words_of(name, model)})
    variables["n_cells"][1][:] = [n for one in found for n in one.counts]
    variables["share"][1][:] = [x for one in found for x in _shares(one)]
    variables[N_POINTS][1][:] = [len(x.points) for x in features]
    variables[N_POINTS][2]["sample_dimension"] = SAMPLE
    points = np.concatenate([np.zeros((0, n_states)), *(x.points for x in features)])
    about = {"units": _BY_STATE, "long_name": "section points"}
    return {**variables, "attractor_points": ((SAMPLE, "state"), points, about), **_transitions(features)}


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
    names = {"from_set": "row of the set that was left", "to": "set of the end", "n_to": "cells that left"}
    return {
        name: (TRANSITION, table[:, k], {"units": "1", "long_name": text})
        for k, (name, text) in enumerate(names.items())
    }


def _words_of(name: str, model: Model | None) -> dict[str, Any]:
    """Return further attributes of a variable: the meanings of its codes, or the unit of the energy."""
    known = {"kind": KINDS, "stability": STABILITIES, "evidence": EVIDENCE}
    if name in known:
        return _flags(" ".join(known[name]))
    if name == "side" and model is not None and model.classifier is not None:
        return flags_of(model.classifier)
    if name.startswith("energy_") and model is not None:
        return {"units": model.quantity(ENERGY).unit}
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


_BY_STATE = "see state_units"

_TABLE: dict[str, tuple[tuple[str, ...], str, float, str, str]] = {
    "kind": ((), "int8", 0, "1", "kind of set"),
    "stability": ((), "int8", 0, "1", "what has been shown of the set"),
    "evidence": ((), "int8", 0, "1", "what the stability rests on"),
    "orbit_period": ((), "int32", 0, "1", "period in drive periods, 0 if bounded or absent"),
    "n_cells": ((), "int64", 0, "1", "cells on the attractor"),
    "share": ((), "float64", 0.0, "1", "share of all cells of the parameter point"),
    N_POINTS: ((), "int32", 0, "1", "stored section points"),
    "rotation": (("angle",), "float64", np.nan, "1", "mean rotation, turns per drive period"),
    "side": ((), "int8", 0, "1", "what the model calls the motion"),
    "state_min": (("state",), "float64", np.nan, _BY_STATE, "least value of the state"),
    "state_max": (("state",), "float64", np.nan, _BY_STATE, "largest value of the state"),
    "energy_min": ((), "float64", np.nan, "1", "least energy"),
    "energy_max": ((), "float64", np.nan, "1", "largest energy"),
    "mirror_partner": ((), "int32", -1, "1", "attractor that is the mirror image, -1 none"),
    "mirror_distance": ((), "float64", np.nan, "1", "distance from the mirror image"),
    "multiplier_real": (("multiplier",), "float64", np.nan, "1", "Floquet multipliers, real part"),
    "multiplier_imag": (("multiplier",), "float64", np.nan, "1", "Floquet multipliers, imaginary part"),
    "residual": ((), "float64", np.nan, "1", "scaled distance of the orbit's first point from its image"),
    "multiplier_error": ((), "float64", np.nan, "1", "error of the largest modulus of the multipliers"),
    "is_polished": ((), "int8", 0, "1", "whether Newton's method converged"),
    "lyapunov_max": ((), "float64", np.nan, "1/s", "largest Lyapunov exponent"),
    "lyapunov_low": ((), "float64", np.nan, "1/s", "largest Lyapunov exponent, lower end of its interval"),
    "lyapunov_high": ((), "float64", np.nan, "1/s", "largest Lyapunov exponent, upper end of its interval"),
    "period_s": ((), "float64", np.nan, "s", "period of a polished orbit"),
    "eigenvalue_real": (("multiplier",), "float64", np.nan, "1/s", "eigenvalues at rest, real part"),
    "eigenvalue_imag": (("multiplier",), "float64", np.nan, "1/s", "eigenvalues at rest, imaginary part"),
    "n_sampled": ((), "int64", 0, "1", "cells of the set, and neighbours, that were extended"),
    "n_left": ((), "int64", 0, "1", "extended cells that left the set"),
    "n_leaving": ((), "int64", 0, "1", "extended cells that were near their end from the start"),
    "time_at_risk": ((), "float64", np.nan, "1", "time on the set in all, drive periods"),
    "mean_lifetime": ((), "float64", np.nan, "1", "mean lifetime in drive periods"),
    "lifetime_low": ((), "float64", np.nan, "1", "lower end of the interval, drive periods"),
    "lifetime_high": ((), "float64", np.nan, "1", "upper end of the interval, drive periods"),
    "dimension": ((), "int8", 0, "1", "dimension of a torus, 0 of any other set"),
    "closes_above": ((), "int32", 0, "1", "period of cells that seem to close above the longest looked for"),
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
        "eigenvalue_": model is None or not model.autonomous,
    }
    return [name for name in _TABLE if not any(name.startswith(k) and out for k, out in left_out.items())]
