"""Coexisting attractors: found at every parameter point, described, followed along the sweep.

    ds = pipeline.open_run(directory)
    found = identify(ds)                 # integrates: Newton's method on one point per orbit
    named = match(found, threshold=0.3)  # does not; repeat it with other options
    loops = hysteresis(ds, named)        # continuation in both directions
    stay = lifetimes(ds, named)          # integrates: which bounded sets are transients, and how long

Schema
------
`identify` and `match` return a Dataset of the same form. Dims: the *parameter dims* of the cube
(``frequency`` and others, in the order of the cube; none if nothing is swept), its *start dims*
(``initial_condition``, the grid's ``psi1_0`` ..., or ``branch``), and ``attractor``, ``point``,
``state``, ``link``, ``multiplier``. Coordinates are those of the cube.

======================== ===================================== ============ ==================================
variable                 dims                                  dtype, fill  meaning
======================== ===================================== ============ ==================================
``attractor_id``         parameter dims, start dims            int32, -1    which attractor; -1: see `status`
``decision``             parameter dims, start dims            int8, 0      how it was decided, see below
``status``               parameter dims, start dims            int8         as in the cube
``kind``                 parameter dims, attractor             int8, 0      0 absent, 1 closed orbit,
                                                                            2 bounded set
``orbit_period``         parameter dims, attractor             int32, 0     drive periods; 0 absent or bounded
``n_cells``              parameter dims, attractor             int64, 0     cells
``share``                parameter dims, attractor             float64, 0   of all cells of the point
``attractor_points``     parameter dims, attractor, point,     float64, NaN section points, below
                         state
``rotation``             parameter dims, attractor, link       float64, NaN mean turns per drive period
``side``                 parameter dims, attractor             int8, 0      codes of `sides.Side`
``state_min``,           parameter dims, attractor, state      float64, NaN range [rad, rad/s], below
``state_max``
``energy_min``,          parameter dims, attractor             float64, NaN range of the energy [J], below
``energy_max``
``mirror_partner``       parameter dims, attractor             int32, -1    attractor that is its image
``mirror_distance``      parameter dims, attractor             float64, NaN nearest attractor to the image
``multiplier_real``,     parameter dims, attractor, multiplier float64, NaN Floquet multipliers over the
``multiplier_imag``                                                         orbit's period, by falling modulus
``residual``             parameter dims, attractor             float64, NaN certificate of Newton's method
``is_stable``            parameter dims, attractor             int8, -1     0 no, 1 yes, -1 not known
``is_polished``          parameter dims, attractor             int8, 0      1 if Newton's method converged
``lyapunov_max``         parameter dims, attractor             float64, NaN largest exponent [1/s]; of bounded
                                                                            sets if the cube has the product
                                                                            ``lyapunov``
======================== ===================================== ============ ==================================

`attractor_points` are NaN beyond the attractor's own: a closed orbit's points in the order of time, or a
sample of a bounded set. Ranges of a polished orbit are those over its full period, angles as they run on
from the first point and -pi to pi for a link that rotates; all others are those of the kept sections, and
the energy of a bounded set that of its stored points.

Distances are in units of the states' scales (1 rad, 10 rad/s for the pendulum), angles on their circle.
From `identify` an id numbers the attractors of one parameter point (attribute ``matched`` 0), in
lexicographic order of the least section point; from `match` it follows an attractor (``matched`` 1), and
where that attractor is absent its row holds the fill values.

`decision` is 0 undecided (no id), 1 closed on the orbit, 2 certain to end on the orbit, 3 approaching the
orbit, 4 one of the set, 5 ended on the orbit when it was run on; `orbits.decide` has the criteria. A cell
that is not bounded (diverged, step limit, pending, unreached) has the id -1, and its own `status`; a
bounded one that belongs to nothing found (see `bounded.Rule`) has the id -1 and `decision` 0. A spiral too
far from its orbit to be told, and a chaotic transient, look like bounded sets here: what they become takes
a longer run, or `lifetimes`. An unstable orbit (`is_stable` 0) is listed only if a cell closed on it.

A run with a loose `closure_tolerance` (1e-3 and more) is short, and its closed cells say little: sections
recur within a few per cent near unstable orbits too, and near a period doubling with half the period.
There a cell belongs only to a polished stable orbit, if it is near enough or spirals in; all others are
run on (`orbits.run_on`) until they close within 1e-5, or stay undecided. So no attractor is made of a
loose closure alone, and the periods are the orbits' own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.engine.system import System
from magpend_core.models.parameters import Parameters
from pipeline.analysis.attractors.bounded import Rule
from pipeline.analysis.attractors.deciding import DECISIONS
from pipeline.analysis.attractors.features import Features
from pipeline.analysis.attractors.hysteresis import hysteresis
from pipeline.analysis.attractors.identify import Found, Options, search_all
from pipeline.analysis.attractors.lifetimes import lifetimes
from pipeline.analysis.attractors.matching import match
from pipeline.analysis.attractors.points import BUDGET, engine_inputs, parameters_of, slabs
from pipeline.analysis.sides import Side
from pipeline.layout.vocabulary import BOUNDED_SET, parameters_of, split_dims
from pipeline.products.lyapunov import LyapunovFlag

__all__ = ["Rule", "hysteresis", "identify", "lifetimes", "match", "parameters_of"]


def identify(
    ds: xr.Dataset,
    *,
    parameters: Parameters | np.ndarray | None = None,
    tolerance: float | None = None,
    polish: bool = True,
    residual: float = 1e-10,
    max_orbit_period: int = 16,
    rule: Rule | None = None,
    n_points: int = 64,
    mirror_threshold: float = 0.3,
    system: System | None = None,
    block_bytes: int = BUDGET,
) -> xr.Dataset:
    """Find the attractors at each parameter point of a cube and assign the cells to them.

    Parameters
    ----------
    ds
        Cube with `section`, `status`, `orbit_period`, and `turns` if there is rotation.
    parameters
        What was integrated; by default as `ds.attrs` say. Axes of the cube replace the values of the
        same name. With another `system`, its packed vector.
    tolerance
        Scaled distance within which a closed cell belongs to an orbit; by default ten times the
        attribute ``closure_tolerance`` of `ds`, and 1e-4 at least: a slow spiral can be eight times
        the closure tolerance away (`magpend_core.engine.observers.closed_period`). Above 1e-3 the run is
        taken as loosely closed, see `pipeline.analysis.attractors.attractors`.
    polish
        Whether to run Newton's method. Without it closed cells are grouped by distance alone, no
        spiral is recognised, and features that need integration are missing.
    residual
        Scaled residual that Newton's method is to reach.
    max_orbit_period
        Longest period guessed for cells that are not closed [drive periods].
    rule
        When bounded sets are the same.
    n_points
        Stored points per attractor, more if an orbit has more.
    mirror_threshold
        Largest distance of a mirror partner from the image.
    system
        By default the pendulum.
    block_bytes
        Sections held in memory at once [bytes]; changes nothing in the result.

    Returns
    -------
    Dataset
        See the text of this module. It does not depend on the order or the chunks of the cells.

    Raises
    ------
    ValueError
        If a variable or the parameters are missing.
    """
    if tolerance is None:
        tolerance = max(1e-4, 10.0 * float(ds.attrs.get("closure_tolerance", 1e-5)))
    elif not tolerance > 0.0:
        raise ValueError(f"tolerance = {tolerance!r} is out of bounds: it must be greater than 0.")
    missing = [name for name in ("section", "status", "orbit_period") if name not in ds]
    if missing:
        raise ValueError(f"The dataset has no {', '.join(missing)}; give the dataset of pipeline.open_run.")
    base, system = engine_inputs(ds, parameters, system, needed=polish)
    options = Options(
        tolerance, polish, residual, max_orbit_period, rule or Rule(), n_points, mirror_threshold
    )
    _, start_dims = split_dims(ds["status"])
    found = {}
    for points in slabs(ds, start_dims, base, system, block_bytes):
        found.update(search_all(points, options, system))
    return _with_exponents(_dataset(ds, start_dims, found, options), ds)


# ---- result ------------------------------------------------------------------------------------


def _flags(words: str) -> dict[str, Any]:
    n = len(words.split())
    return {"flag_values": np.arange(n, dtype=np.int8), "flag_meanings": words}


def _dataset(
    ds: xr.Dataset, start_dims: tuple[str, ...], found: Mapping[tuple[int, ...], Found], options: Options
) -> xr.Dataset:
    """Result of `identify`, in the schema of the module."""
    dims, _ = split_dims(ds["status"])
    shape = tuple(ds.sizes[d] for d in dims)
    table = _filled(ds, dims, shape, found, options)
    n = table.n
    result = xr.Dataset(table.variables())
    cell_dims = (*dims, *start_dims)
    cell_shape = (*shape, *(ds.sizes[d] for d in start_dims))
    ids, decisions = np.empty(cell_shape, np.int32), np.empty(cell_shape, np.int8)
    for index, one in found.items():
        ids[index] = one.label.reshape(cell_shape[len(dims) :])
        decisions[index] = one.decision.reshape(cell_shape[len(dims) :])
    result["attractor_id"] = (cell_dims, ids, {"units": "1", "long_name": "attractor of the cell, -1 none"})
    result["decision"] = (
        cell_dims,
        decisions,
        {"units": "1", "long_name": "how the cell was decided", **_flags(" ".join(DECISIONS))},
    )
    about = {"units": "1", "long_name": "what became of the cell", **ds["status"].attrs}
    result["status"] = (cell_dims, ds["status"].transpose(*cell_dims).values, about)
    keep = {k: v for k, v in ds.coords.items() if set(v.dims) <= set(cell_dims) | {"state", "link"}}
    result = result.assign_coords(keep).assign_coords(
        attractor=("attractor", np.arange(n, dtype=np.int32), {"units": "1", "long_name": "attractor"})
    )
    kept = {k: v for k, v in ds.attrs.items() if k != "title"}
    settings = {**asdict(options), **{f"rule_{k}": v for k, v in asdict(options.rule).items()}}
    settings = {
        f"identify_{k}": int(v) if isinstance(v, bool) else v for k, v in settings.items() if k != "rule"
    }
    return result.assign_attrs({**kept, **settings, "matched": 0})


def _filled(
    ds: xr.Dataset, dims: tuple[str, ...], shape: tuple[int, ...],
    found: Mapping[tuple[int, ...], Found], options: Options,
) -> _Table:  # fmt: skip
    """Table of the attractors of all parameter points."""
    n = max((len(f.features) for f in found.values()), default=0)
    longest = max((len(x.points) for f in found.values() for x in f.features), default=0)
    n_points = max(options.n_points, longest)
    names = (
        [str(s) for s in ds["state"].values]
        if "state" in ds.coords
        else [str(i) for i in range(ds.sizes["state"])]
    )
    n_links = next((x.rotation.shape[0] for f in found.values() for x in f.features), ds.sizes.get("link", 0))
    table = _Table(
        dims, shape, n, {"point": n_points, "state": len(names), "link": n_links, "multiplier": len(names)}
    )
    for index, one in found.items():
        total = one.label.size
        for i, x in enumerate(one.features):
            table.fill((*index, i), x, one.counts[i], total)
    return table


def _with_exponents(result: xr.Dataset, ds: xr.Dataset) -> xr.Dataset:
    """Fill in the largest exponent of bounded sets, the mean over their cells, where the cube has it."""
    if "lyapunov" not in ds:
        return result
    dims = result["attractor_id"].dims
    rate = ds["lyapunov"].isel(exponent=0, drop=True).transpose(*dims).values
    good = ds["lyapunov_flag"].transpose(*dims).values == LyapunovFlag.GOOD
    ids, kind = result["attractor_id"].values, result["kind"].values
    for index in np.argwhere(kind == BOUNDED_SET):
        point, i = tuple(index[:-1]), index[-1]
        own = rate[point][(ids[point] == i) & good[point]]
        if own.size:  # in rising order, so that the last bit does not depend on that of the cells
            result["lyapunov_max"].values[tuple(index)] = np.sort(own).mean()
    return result


_STATE_UNITS = "rad, rad, rad/s, rad/s"

_TABLE: dict[str, tuple[tuple[str, ...], str, float, str, str]] = {
    "kind": ((), "int8", 0, "1", "kind of attractor"),
    "orbit_period": ((), "int32", 0, "1", "period in drive periods, 0 if bounded or absent"),
    "n_cells": ((), "int64", 0, "1", "cells on the attractor"),
    "share": ((), "float64", 0.0, "1", "share of all cells of the parameter point"),
    "attractor_points": (("point", "state"), "float64", np.nan, _STATE_UNITS, "section points"),
    "rotation": (("link",), "float64", np.nan, "1", "mean rotation of the link, turns per drive period"),
    "side": ((), "int8", 0, "1", "side of the fixed magnet on which the motion stays"),
    "state_min": (("state",), "float64", np.nan, _STATE_UNITS, "least value of the state"),
    "state_max": (("state",), "float64", np.nan, _STATE_UNITS, "largest value of the state"),
    "energy_min": ((), "float64", np.nan, "J", "least mechanical energy"),
    "energy_max": ((), "float64", np.nan, "J", "largest mechanical energy"),
    "mirror_partner": ((), "int32", -1, "1", "attractor that is the mirror image, -1 none"),
    "mirror_distance": ((), "float64", np.nan, "1", "distance from the mirror image"),
    "multiplier_real": (("multiplier",), "float64", np.nan, "1", "Floquet multipliers, real part"),
    "multiplier_imag": (("multiplier",), "float64", np.nan, "1", "Floquet multipliers, imaginary part"),
    "residual": ((), "float64", np.nan, "1", "scaled distance of the orbit's first point from its image"),
    "is_stable": ((), "int8", -1, "1", "whether all multipliers lie inside the unit circle, -1 not known"),
    "is_polished": ((), "int8", 0, "1", "whether Newton's method converged"),
    "lyapunov_max": ((), "float64", np.nan, "1/s", "largest Lyapunov exponent"),
}  # fmt: skip
"""Own dims, dtype, fill, units and long name of the variables per attractor."""


class _Table:
    """Arrays of the variables per attractor."""

    def __init__(
        self, dims: tuple[str, ...], shape: tuple[int, ...], n: int, sizes: Mapping[str, int]
    ) -> None:
        self._dims, self.n = (*dims, "attractor"), n
        self.arrays = {
            name: np.full((*shape, n, *(sizes[d] for d in own)), fill, dtype)
            for name, (own, dtype, fill, _, _) in _TABLE.items()
        }

    def fill(self, at: tuple[int, ...], x: Features, n_cells: int, total: int) -> None:
        """Write one attractor."""
        arrays = self.arrays
        arrays["n_cells"][at], arrays["share"][at] = n_cells, n_cells / total
        arrays["attractor_points"][at][: len(x.points)] = x.points
        if x.multipliers is not None:
            arrays["multiplier_real"][at], arrays["multiplier_imag"][at] = (
                x.multipliers.real,
                x.multipliers.imag,
            )
        for name in arrays.keys() - {
            "n_cells",
            "share",
            "attractor_points",
            "multiplier_real",
            "multiplier_imag",
        }:
            arrays[name][at] = getattr(x, name)

    def variables(self) -> dict[str, Any]:
        """As xarray takes them."""
        sides = " ".join(s.name.lower() for s in Side)
        more = {"kind": _flags("absent closed_orbit bounded_set"), "side": _flags(sides)}
        return {
            name: (
                (*self._dims, *own),
                self.arrays[name],
                {"units": units, "long_name": text, **more.get(name, {})},
            )
            for name, (own, _, _, units, text) in _TABLE.items()
        }
