"""Transient or attractor? A sample of each bounded set is run on.

    found = identify(ds)
    stay = lifetimes(ds, found)          # integrates: n_sample cells of every bounded set

A run that ends cannot tell a chaotic attractor from a chaotic transient. Here some cells of each bounded
set go on from their last kept section, until an orbit is seen to take them or for `n_periods` drive
periods. A cell leaves at the last section before those that stay within `deciding.REACH` of the orbit on
which it ends. Escape from a chaotic saddle forgets the past, so lifetimes beyond the first few periods
are exponential (Kantz and Grassberger, Physica D 17 (1985) 75; Lai and Tel, Transient Chaos, 2011, ch. 1).
With r escapes in the total time at risk T, of all sampled cells together, the mean lifetime is T/r, and
its interval at confidence 1 - a runs from ``2 T/chi2(1 - a/2; 2 r + 2)`` to ``2 T/chi2(a/2; 2 r)``
(Epstein and Sobel, J. Am. Stat. Assoc. 48 (1953) 486, and Garwood, Biometrika 28 (1936) 437, for
observation that ends at a given time). If none leaves, the one-sided bound is ``T/(-ln a)``, a third of T
at 95 %.

Schema
------
Dims: the *parameter dims* and ``attractor`` as in `attractors`; ``destination``, the
attractors by their ids, then the orbits found here; ``new_orbit``, one at least; ``sample``, cells by
rising hash of their sections; ``state``.

======================= ========================= ============= ===========================================
variable                own dims                  dtype, fill   meaning
======================= ========================= ============= ===========================================
``verdict``             attractor                 int8, 0       0 no bounded set, 1 attractor as far as
                                                                seen (none left), 2 transient (some left)
``n_sampled``           attractor                 int64, 0      cells run on
``n_left``              attractor                 int64, 0      of these, that left while at risk
``n_leaving``           attractor                 int64, 0      that were near their orbit from the start:
                                                                not at risk
``time_at_risk``        attractor                 float64, NaN  in all [drive periods]
``mean_lifetime``       attractor                 float64, NaN  T/r [drive periods]; NaN if none left
``lifetime_low``,       attractor                 float64, NaN  interval, or the bound and infinity
``lifetime_high``                                               [drive periods]
``n_to``                attractor, destination    int64, 0      cells that ended there
``sample_cell``         attractor, sample         int64, -1     place among the cells of the point, in the
                                                                order of the start dims
``sample_destination``  attractor, sample         int32, -1     destination; -1 still on the set, -2 failed
``sample_periods``      attractor, sample         float64, NaN  time at risk [drive periods]
``new_orbit_period``    new_orbit                 int32, 0      drive periods; 0 for no orbit
``new_orbit_points``    new_orbit, state          float64, NaN  first section point
``new_orbit_multiplier``  new_orbit               float64, NaN  largest modulus
======================= ========================= ============= ===========================================

What this does not show: a set from which none of the sample leaves may be a transient that lives longer
than the bound, and one cell that leaves makes the verdict "transient" though the rest may be an
attractor beside whose basin it was. A mean lifetime far beyond `n_periods` with few escapes asks for a
longer run.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from scipy.stats import chi2

from magpend_core.engine.system import System
from magpend_core.models.parameters import Parameters
from pipeline.analysis.attractors.cells import marks_of
from pipeline.analysis.attractors.following import FAILED, LEG, ON_SET, Ends, Engine, follow
from pipeline.analysis.attractors.orbits import Orbit
from pipeline.analysis.attractors.points import BUDGET, Dynamics, Point, slabs
from pipeline.layout.vocabulary import BOUNDED_SET, split_dims
from pipeline.products.attractors import SettlingOptions

ABSENT, ATTRACTOR, TRANSIENT = range(3)
"""Values of `verdict`."""


def lifetime_interval(n_left: int, time_at_risk: float, confidence: float = 0.95) -> tuple[float, float]:
    """Confidence interval of the mean lifetime from escapes and the total time at risk.

    Parameters
    ----------
    n_left
        Escapes.
    time_at_risk
        Sum over cells until they left, or were looked at last, in any unit.
    confidence
        Between 0 and 1. The interval is two-sided if any left, else a lower bound.

    Returns
    -------
    low, high : float
        In the unit of `time_at_risk`; `high` is infinite if none left.

    Raises
    ------
    ValueError
        If `confidence` is out of bounds.

    Examples
    --------
    >>> low, high = lifetime_interval(0, 3000.0)
    >>> round(low), high
    (1001, inf)
    """
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence = {confidence!r} is out of bounds: it must lie between 0 and 1.")
    if n_left == 0:
        return 2.0 * time_at_risk / float(chi2.ppf(confidence, 2)), np.inf
    tail = 0.5 * (1.0 - confidence)
    low = 2.0 * time_at_risk / float(chi2.isf(tail, 2 * n_left + 2))
    return low, 2.0 * time_at_risk / float(chi2.ppf(tail, 2 * n_left))


def lifetimes(
    ds: xr.Dataset,
    attractors: xr.Dataset,
    options: SettlingOptions | None = None,
    *,
    parameters: Parameters | np.ndarray | None = None,
    system: System | None = None,
    block_bytes: int = BUDGET,
    **changes: Any,
) -> xr.Dataset:
    """Run a sample of every bounded set on, and say how many left it, where they went and how fast.

    Parameters
    ----------
    ds
        The cube.
    attractors
        What `identify` or `match` made of it.
    options
        By default those of `SettlingOptions`: of each set the `n_sample` cells of least hash are run on, all
        if it has fewer, for `n_periods` rounded up to whole legs of `LEG`. Tolerances of 0 stand for those
        of the run, from the attributes of `ds`, else 1e-8.
    parameters, system, block_bytes
        As for `identify`.
    changes
        Fields of the options, instead of `options`.

    Returns
    -------
    Dataset
        See the text of this module. It depends on neither the order nor the chunks of the cells,
        apart from `sample_cell`, which names them.

    Raises
    ------
    ValueError
        If an option is out of bounds, the parameters are missing, or `attractors` are those of another
        cube.
    """
    options = options or SettlingOptions(**changes)
    if attractors["attractor_id"].sizes != ds["status"].sizes:
        raise ValueError("attractors and ds have other cells; give what identify made of this cube.")
    dynamics = Dynamics.of(ds, parameters, system)
    tolerances = (
        options.rtol or float(ds.attrs.get("rtol", 1e-8)),
        options.atol or float(ds.attrs.get("atol", 1e-8)),
    )
    dims, _ = split_dims(ds["status"])
    n_legs = -(-options.n_periods // LEG)
    courses: dict[tuple[int, ...], Courses] = {}
    for points in slabs(ds, dynamics, block_bytes):
        ids = {i: attractors.isel(dict(zip(dims, i, strict=True))) for i in points}
        samples = {i: _sample(point, ids[i], options.n_sample) for i, point in points.items()}
        places = {i: s for i, s in samples.items() if len(s.cell)}
        if not places:
            continue
        owner = np.repeat(np.arange(len(places)), [len(s.cell) for s in places.values()])
        start = np.concatenate([s.start for s in places.values()])
        engine = Engine(
            np.stack([points[i].packed for i in places]),
            np.array([points[i].frequency for i in places]),
            owner, start, tolerances=tolerances, max_orbit_period=options.max_orbit_period,
            residual=options.residual, geometry=dynamics.geometry, system=dynamics.integrates,
        )  # fmt: skip
        known = engine.known([_orbits_of(ids[i]) for i in places])
        ends = follow(
            start, owner, known, engine.advance, engine.polish, n_legs,
            options.max_orbit_period, dynamics.geometry,
        )  # fmt: skip
        first = 0
        for number, (index, sample) in enumerate(places.items()):
            rows = slice(first, first + len(sample.cell))
            rows_of = _orbits_of(ids[index])[0]
            courses[index] = Courses(sample, ends.take(rows), rows_of, ends.orbits[number])
            first = rows.stop
    done = {"n_sample": options.n_sample, "n_periods": n_legs * LEG, "confidence": options.confidence}
    return _dataset(attractors, dims, courses, done)


# ---- sample and engine -------------------------------------------------------------------------


@dataclass(frozen=True)
class Sample:
    """Cells of one parameter point that are run on.

    Attributes
    ----------
    cell : ndarray of int64
        Place among the cells of the point.
    attractor : ndarray of int64
        The set.
    start : ndarray, (n, state)
        Last kept section.
    """

    cell: np.ndarray
    attractor: np.ndarray
    start: np.ndarray


def _sample(point: Point, ids: xr.Dataset, n_sample: int) -> Sample:
    """Return the cells of least hash of every bounded set; cells of equal sections count once."""
    label = ids["attractor_id"].transpose(*point.start_dims).values.ravel()
    sets = np.flatnonzero(ids["kind"].values == BOUNDED_SET)
    n = point.n_states
    best = {int(a): (np.zeros(0, np.uint64), np.zeros(0, np.int64), np.zeros((0, n))) for a in sets}
    for block in point.blocks():
        own = label[block.cells]
        for a in best:
            rows = np.flatnonzero(own == a)
            if len(rows):
                more = marks_of(block.section[rows]), rows + block.cells.start, block.section[rows, -1]
                mark, cell, start = (np.concatenate(pair) for pair in zip(best[a], more, strict=True))
                least = np.unique(mark, return_index=True)[1][:n_sample]
                best[a] = mark[least], cell[least], start[least]
    cells = [x[1] for x in best.values()] or [np.zeros(0, np.int64)]
    starts = [x[2] for x in best.values()] or [np.zeros((0, n))]
    owner = np.repeat(np.array(list(best), np.int64), [len(x[1]) for x in best.values()])
    return Sample(np.concatenate(cells), owner, np.concatenate(starts))


def _orbits_of(ids: xr.Dataset) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, first points and periods of the polished orbits of one parameter point."""
    rows = np.flatnonzero(ids["is_polished"].values == 1)
    return rows, ids["attractor_points"].values[rows, 0], ids["orbit_period"].values[rows].astype(np.int64)


# ---- result ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Courses:
    """Sample of a parameter point, its ends, the rows of its known orbits, and all its orbits."""

    sample: Sample
    ends: Ends
    known: np.ndarray
    orbits: list[Orbit]

    @property
    def new(self) -> list[Orbit]:
        """Orbits on which cells ended and which were not known."""
        return self.orbits[len(self.known) :]

    def destinations(self, n_attractors: int) -> np.ndarray:
        """Destination of each cell."""
        table = np.concatenate([self.known, n_attractors + np.arange(len(self.new)), [FAILED, ON_SET]])
        return np.asarray(table[self.ends.orbit], np.int32)


def _dataset(
    attractors: xr.Dataset, dims: tuple[str, ...], courses: dict[tuple[int, ...], Courses],
    options: dict[str, Any],
) -> xr.Dataset:  # fmt: skip
    shape, n = tuple(attractors.sizes[d] for d in dims), attractors.sizes["attractor"]
    n_new = max((len(c.new) for c in courses.values()), default=0) or 1
    sizes = {"destination": n + n_new, "sample": options["n_sample"], "new_orbit": n_new,
             "state": attractors.sizes["state"], "attractor": n}  # fmt: skip
    arrays = {
        name: np.full((*shape, *(sizes[d] for d in own)), fill, dtype)
        for name, (own, dtype, fill, _, _) in _TABLE.items()
    }
    for index, one in courses.items():
        destination = one.destinations(n)
        for a in np.unique(one.sample.attractor):
            rows = np.flatnonzero(one.sample.attractor == a)
            _fill(arrays, (*index, a), one, rows, destination[rows], options["confidence"])
        for i, orbit in enumerate(one.new):
            arrays["new_orbit_period"][(*index, i)] = orbit.period
            arrays["new_orbit_points"][(*index, i)] = orbit.points[0]
            arrays["new_orbit_multiplier"][(*index, i)] = np.abs(orbit.multipliers).max()
    flags = {
        "flag_values": np.arange(3, dtype=np.int8),
        "flag_meanings": "no_bounded_set attractor transient",
    }
    variables = {
        name: ((*dims, *own), arrays[name],
               {"units": units, "long_name": text, **(flags if name == "verdict" else {})})
        for name, (own, _, _, units, text) in _TABLE.items()
    }  # fmt: skip
    names = [name for name, c in attractors.coords.items() if set(c.dims) <= {*dims, "attractor", "state"}]
    kept = {k: v for k, v in attractors.attrs.items() if k != "title"}
    result = xr.Dataset(variables, {name: attractors.coords[name] for name in names}, kept)
    return result.assign_attrs({f"lifetimes_{k}": v for k, v in options.items()})


def _fill(
    arrays: dict[str, np.ndarray], at: tuple[Any, ...], one: Courses, rows: np.ndarray,
    destination: np.ndarray, confidence: float,
) -> None:  # fmt: skip
    """Write the numbers of one set."""
    leaving, periods = one.ends.is_leaving[rows], one.ends.periods[rows]
    n_left = int((~leaving & (destination != ON_SET)).sum())
    at_risk = float(np.sort(periods).sum())
    arrays["n_sampled"][at], arrays["n_left"][at] = len(rows), n_left
    arrays["n_leaving"][at], arrays["time_at_risk"][at] = leaving.sum(), at_risk
    if at_risk > 0.0:
        arrays["mean_lifetime"][at] = at_risk / n_left if n_left else np.nan
        low, high = lifetime_interval(n_left, at_risk, confidence)
        arrays["lifetime_low"][at], arrays["lifetime_high"][at] = low, high
    arrays["verdict"][at] = TRANSIENT if (destination != ON_SET).any() else ATTRACTOR
    arrays["n_to"][at] = np.bincount(destination[destination >= 0], minlength=arrays["n_to"].shape[-1])
    for name, values in (("cell", one.sample.cell[rows]), ("destination", destination), ("periods", periods)):
        arrays[f"sample_{name}"][at][: len(rows)] = values


_TABLE: dict[str, tuple[tuple[str, ...], str, float, str, str]] = {
    "verdict": (("attractor",), "int8", 0, "1", "transient or attractor, as far as seen"),
    "n_sampled": (("attractor",), "int64", 0, "1", "cells of the set that were run on"),
    "n_left": (("attractor",), "int64", 0, "1", "sampled cells that left the set"),
    "n_leaving": (("attractor",), "int64", 0, "1", "sampled cells near their orbit from the start"),
    "time_at_risk": (("attractor",), "float64", np.nan, "1", "time on the set in all, drive periods"),
    "mean_lifetime": (("attractor",), "float64", np.nan, "1", "mean lifetime in drive periods"),
    "lifetime_low": (("attractor",), "float64", np.nan, "1", "lower end of the interval, drive periods"),
    "lifetime_high": (("attractor",), "float64", np.nan, "1", "upper end of the interval, drive periods"),
    "n_to": (("attractor", "destination"), "int64", 0, "1", "sampled cells that ended there"),
    "sample_cell": (("attractor", "sample"), "int64", -1, "1", "sampled cell, by its place"),
    "sample_destination": (("attractor", "sample"), "int32", ON_SET, "1", "where it ended, -1 on the set"),
    "sample_periods": (("attractor", "sample"), "float64", np.nan, "1", "its time on the set, drive periods"),
    "new_orbit_period": (("new_orbit",), "int32", 0, "1", "period in drive periods"),
    "new_orbit_points": (("new_orbit", "state"), "float64", np.nan, "see state_units", "section point"),
    "new_orbit_multiplier": (("new_orbit",), "float64", np.nan, "1", "largest modulus of a multiplier"),
}  # fmt: skip
"""Own dims, dtype, fill, units and long name."""
