"""Transient or attractor? A sample of each bounded set is run on.

    found = identify(ds)
    stay = lifetimes(ds, found)          # integrates: n_sample cells of every bounded set

A run that ends cannot tell a chaotic attractor from a chaotic transient. Here some cells of each bounded
set go on from their last kept section, until an orbit is seen to take them or for `n_periods` drive
periods. A cell leaves at the last section before those that stay within `orbits.REACH` of the orbit on
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
attractors by their ids, then the orbits found here; ``new_orbit``; ``sample``, cells by rising hash
of their sections; ``state``.

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
``new_orbit_period``    new_orbit                 int32, 0      drive periods
``new_orbit_points``    new_orbit, state          float64, NaN  first section point [rad, rad/s]
``new_orbit_multiplier``  new_orbit               float64, NaN  largest modulus
======================= ========================= ============= ===========================================

What this does not show: a set from which none of the sample leaves may be a transient that lives longer
than the bound, and one cell that leaves makes the verdict "transient" though the rest may be an
attractor beside whose basin it was. A mean lifetime far beyond `n_periods` with few escapes asks for a
longer run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr
from scipy.stats import chi2

from magpend_core.engine.system import System
from magpend_core.models.parameters import Parameters
from magpend_core.sections import run_branches
from magpend_core.status import Status
from pipeline.analysis.attractors.identify import BUDGET, Point, engine_inputs, slabs
from pipeline.analysis.attractors.orbits import (
    REACH,
    Block,
    ClosedCells,
    Guesses,
    Orbit,
    decide,
    distinct,
    marks_of,
    near_closed,
    number_of,
    polish,
)
from pipeline.analysis.sets import Geometry
from pipeline.layout.vocabulary import BOUNDED_SET, split_dims

LEG = 64
"""Drive periods between two looks at where the cells are."""

TOLERANCE = 1e-4
"""Scaled distance within which a closed cell belongs to an orbit; its closure is ten times stricter."""

ON_SET, FAILED = -1, -2
"""Values of `sample_destination` that are no destinations."""

ABSENT, ATTRACTOR, TRANSIENT = range(3)
"""Values of `verdict`."""

Advance = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""From rows to their next `LEG` sections (n, LEG, state), status and orbit period."""

Polish = Callable[[np.ndarray, np.ndarray, np.ndarray], list[Orbit | None]]
"""From parameter points (n,), guesses (n, state) and periods (n,) to orbits."""


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
    *,
    n_sample: int = 32,
    n_periods: int = 1024,
    confidence: float = 0.95,
    max_orbit_period: int = 16,
    residual: float = 1e-10,
    rtol: float = 0.0,
    atol: float = 0.0,
    parameters: Parameters | np.ndarray | None = None,
    system: System | None = None,
    block_bytes: int = BUDGET,
) -> xr.Dataset:
    """Run a sample of every bounded set on, and say how many left it, where they went and how fast.

    Parameters
    ----------
    ds
        The cube.
    attractors
        What `identify` or `match` made of it.
    n_sample
        Cells of each set, those of least hash; all if it has fewer.
    n_periods
        Drive periods that they are run on, rounded up to whole legs of `LEG`.
    confidence
        Of the intervals, see `lifetime_interval`.
    max_orbit_period
        Longest period of an orbit not known before [drive periods].
    residual
        Scaled residual that Newton's method is to reach.
    rtol, atol
        Tolerances; 0 takes those of the run, from the attributes of `ds`, else 1e-8.
    parameters, system, block_bytes
        As for `identify`.

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
    for name, value in (("n_sample", n_sample), ("n_periods", n_periods)):
        if value < 1:
            raise ValueError(f"{name} = {value!r} is out of bounds: it must be 1 or more.")
    lifetime_interval(0, 0.0, confidence)
    if attractors["attractor_id"].sizes != ds["status"].sizes:
        raise ValueError("attractors and ds have other cells; give what identify made of this cube.")
    base, system = engine_inputs(ds, parameters, system, needed=True)
    tolerances = rtol or float(ds.attrs.get("rtol", 1e-8)), atol or float(ds.attrs.get("atol", 1e-8))
    dims, start_dims = split_dims(ds["status"])
    geometry = Geometry.of(system)
    n_legs = -(-n_periods // LEG)
    courses: dict[tuple[int, ...], Courses] = {}
    for points in slabs(ds, start_dims, base, system, block_bytes):
        ids = {i: attractors.isel(dict(zip(dims, i, strict=True))) for i in points}
        samples = {i: _sample(point, ids[i], n_sample) for i, point in points.items()}
        places = {i: s for i, s in samples.items() if len(s.cell)}
        if not places:
            continue
        engine = _Engine([points[i] for i in places], list(places.values()), system, tolerances,
                         max_orbit_period, residual, geometry)  # fmt: skip
        known = engine.known([_orbits_of(ids[i]) for i in places])
        ends = follow(
            np.concatenate([s.start for s in places.values()]),
            np.repeat(np.arange(len(places)), [len(s.cell) for s in places.values()]),
            known, engine.advance, engine.polish, n_legs, max_orbit_period, geometry,
        )  # fmt: skip
        first = 0
        for number, (index, sample) in enumerate(places.items()):
            rows = slice(first, first + len(sample.cell))
            rows_of = _orbits_of(ids[index])[0]
            courses[index] = Courses(sample, ends.take(rows), rows_of, ends.orbits[number])
            first = rows.stop
    options = {"n_sample": n_sample, "n_periods": n_legs * LEG, "confidence": confidence}
    return _dataset(attractors, dims, courses, n_sample, options)


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
    n = len(point.state_names)
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


class _Engine:
    """Integrates the sampled cells of some parameter points, bit for bit as if without a stop."""

    def __init__(
        self, points: Sequence[Point], samples: Sequence[Sample], system: System,
        tolerances: tuple[float, float], max_orbit_period: int, residual: float, geometry: Geometry,
    ) -> None:  # fmt: skip
        sizes = [len(s.cell) for s in samples]
        self._point_packed = np.stack([p.packed for p in points])
        self._point_frequency = np.array([p.frequency for p in points])
        self._owner = np.repeat(np.arange(len(points)), sizes)
        self._state = np.concatenate([s.start for s in samples])
        self._step = np.zeros(len(self._owner))
        self._system, self._geometry, self._residual = system, geometry, residual
        self._options: dict[str, Any] = {
            "n_transient": 0, "n_keep": LEG, "rtol": tolerances[0], "atol": tolerances[1],
            "closure_tolerance": 0.1 * TOLERANCE, "max_orbit_period": max_orbit_period, "system": system,
        }  # fmt: skip

    def advance(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `Advance`."""
        owner = self._owner[rows]
        result = run_branches(
            self._point_packed[owner][:, None], self._point_frequency[owner][:, None], self._state[rows],
            step_size=self._step[rows], **self._options,
        )  # fmt: skip
        self._state[rows], self._step[rows] = result.final_state, result.step_size
        return result.section[:, 0], result.status[:, 0], result.orbit_period[:, 0]

    def polish(self, owner: np.ndarray, point: np.ndarray, period: np.ndarray) -> list[Orbit | None]:
        """See `Polish`."""
        return polish(
            self._point_packed[owner], self._point_frequency[owner], point, period,
            geometry=self._geometry, system=self._system, tolerance=self._residual,
        )  # fmt: skip

    def known(self, orbits: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> list[list[Orbit]]:
        """Orbits of every parameter point with their monodromy matrices, which are not stored."""
        sizes = [len(rows) for rows, _, _ in orbits]
        polished = self.polish(
            np.repeat(np.arange(len(orbits)), sizes),
            np.concatenate([p for _, p, _ in orbits]),
            np.concatenate([q for _, _, q in orbits]),
        )
        if any(orbit is None for orbit in polished):
            raise ValueError("A stored orbit is none with these parameters; give those of the run.")
        found = [orbit for orbit in polished if orbit is not None]
        ends = np.cumsum(sizes)
        return [found[end - n : end] for n, end in zip(sizes, ends, strict=True)]


# ---- following ---------------------------------------------------------------------------------


@dataclass
class Ends:
    """What became of the cells that were run on.

    Attributes
    ----------
    orbit : ndarray of int64
        Number among the orbits of the cell's parameter point, or `ON_SET`, `FAILED`.
    periods : ndarray
        Drive periods at risk.
    is_leaving : ndarray of bool
        Near the orbit from the start.
    orbits : list of list of Orbit
        Of each parameter point: those given, then those found.
    """

    orbit: np.ndarray
    periods: np.ndarray
    is_leaving: np.ndarray
    orbits: list[list[Orbit]] = field(default_factory=list)

    def take(self, rows: slice) -> Ends:
        """Some of the cells."""
        return Ends(self.orbit[rows], self.periods[rows], self.is_leaving[rows])


def follow(
    start: np.ndarray, owner: np.ndarray, orbits: Sequence[Sequence[Orbit]], advance: Advance,
    polish_new: Polish, n_legs: int, max_orbit_period: int, geometry: Geometry,
) -> Ends:  # fmt: skip
    """Run cells on, leg by leg, until each is seen on its way to an orbit.

    Parameters
    ----------
    start
        Section points, shape (n, state).
    owner
        Parameter point of each, a number.
    orbits
        Known orbits of each parameter point.
    advance, polish_new
        What integrates.
    n_legs
        Legs of `LEG` drive periods, at most.
    max_orbit_period
        Longest period guessed.
    geometry
        Of the states.
    """
    ends = Ends(
        np.full(len(start), ON_SET), np.full(len(start), float(n_legs * LEG)),
        np.zeros(len(start), bool), [list(x) for x in orbits],
    )  # fmt: skip
    paths = [[s[None]] for s in start]
    tried: list[set[int]] = [set() for _ in orbits]
    for leg in range(n_legs):
        rows = np.flatnonzero(ends.orbit == ON_SET)
        if not len(rows):
            break
        section, status, period = advance(rows)
        computed = np.isin(status, (Status.PERIODIC, Status.BOUNDED))
        ends.orbit[rows[~computed]], ends.periods[rows[~computed]] = FAILED, (leg + 1.0) * LEG
        rows, section = rows[computed], section[computed]
        for row, states in zip(rows, section, strict=True):
            paths[row].append(states)
        whole = Block(slice(0, 0), section, status[computed], period[computed], np.zeros((len(rows), 0)))
        _search(whole, owner[rows], ends.orbits, tried, polish_new, max_orbit_period, geometry)
        for point in np.unique(owner[rows]):
            own = np.flatnonzero(owner[rows] == point)
            label, _ = decide(whole.take(own), ends.orbits[point], TOLERANCE, geometry)
            for row, number in zip(rows[own], label, strict=True):
                if number >= 0 and ends.orbits[point][number].is_stable:
                    _leave(ends, row, number, ends.orbits[point][number], paths[row], geometry)
                    paths[row] = []
    return ends


def _leave(
    ends: Ends, row: int, number: int, orbit: Orbit, path: list[np.ndarray], geometry: Geometry
) -> None:
    """Note when a cell came near the orbit for good."""
    states = np.concatenate(path)
    phase = int(np.argmin(geometry.distance(orbit.points, states[-1])))
    back = np.arange(len(states))
    near = geometry.distance(states[::-1], orbit.points[(phase - back) % orbit.period]) <= REACH
    entered = len(states) - (len(near) if near.all() else int(np.argmin(near)))
    ends.orbit[row], ends.periods[row], ends.is_leaving[row] = number, float(entered), entered == 0


def _search(
    block: Block, owner: np.ndarray, orbits: list[list[Orbit]], tried: list[set[int]],
    polish_new: Polish, max_orbit_period: int, geometry: Geometry,
) -> None:  # fmt: skip
    """Polish what undecided cells close on, or come back to, and add what is new to `orbits`."""
    guesses: list[Guesses] = []
    points: list[int] = []
    for point in np.unique(owner):
        own = block.take(np.flatnonzero(owner == point))
        label, _ = decide(own, orbits[point], TOLERANCE, geometry)
        rest = own.take(np.flatnonzero(label < 0))
        closed = ClosedCells(geometry, TOLERANCE, Guesses.none(len(geometry.scales)))
        closed.add(rest)
        loose = rest.section[rest.is_bounded]
        found = closed.guesses.joined(near_closed(loose, max_orbit_period, geometry))
        new = [i for i, key in enumerate(found.key.tolist()) if key not in tried[point]]
        tried[point].update(found.key[new].tolist())
        guesses.append(found.take(np.array(new, np.int64)))
        points += [int(point)] * len(new)
    if not points:
        return
    polished = polish_new(
        np.array(points),
        np.concatenate([g.point for g in guesses]),
        np.concatenate([g.period for g in guesses]),
    )
    for point in set(points):
        own_orbits = [o for o, p in zip(polished, points, strict=True) if p == point and o is not None]
        for orbit in distinct(own_orbits, geometry):
            if orbit.is_stable and number_of(orbit, orbits[point], geometry) == len(orbits[point]):
                orbits[point].append(orbit)


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
    attractors: xr.Dataset, dims: tuple[str, ...], courses: dict[tuple[int, ...], Courses], n_sample: int,
    options: dict[str, float],
) -> xr.Dataset:  # fmt: skip
    shape, n = tuple(attractors.sizes[d] for d in dims), attractors.sizes["attractor"]
    n_new = max((len(c.new) for c in courses.values()), default=0)
    sizes = {"destination": n + n_new, "sample": n_sample, "new_orbit": n_new,
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


_STATE_UNITS = "rad, rad, rad/s, rad/s"

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
    "new_orbit_points": (("new_orbit", "state"), "float64", np.nan, _STATE_UNITS, "section point"),
    "new_orbit_multiplier": (("new_orbit",), "float64", np.nan, "1", "largest modulus of a multiplier"),
}  # fmt: skip
"""Own dims, dtype, fill, units and long name."""
