"""Write branches and orbits in the files of AUTO-07p: the table ``b.NAME``, and ``NAME.dat``, an orbit to start from.

The layout is that of AUTO-07p's own output (E. J. Doedel and B. E. Oldeman, *AUTO-07P: continuation and bifurcation
software for ordinary differential equations*, Concordia University, Montreal 2012, section "Output files"). A line has
the number of the branch (negative for periodic orbits), the number of the point (negative if it is stable), the type
(`_TYPES`), the label, the parameter, the L2-norm, the states or their maxima, and of periodic orbits the period.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from magpend_core.models.sectioned import of_flow
from magpend_core.pointwise import evaluate
from pipeline.analysis.branches.kinds import BRANCH_POINTS, DOUBLING, FOLD, HOPF, TORUS
from pipeline.analysis.response.analysis import orbit_at, orbit_at_bifurcation
from pipeline.analysis.response.orbits import Orbit, flown, highest, sampled
from pipeline.compute.simulate import labelled
from pipeline.layout.own_words import in_own_words, with_plain_names
from pipeline.layout.vocabulary import model_of, parameter_name, parameters_of
from pipeline.results.tabular import words_of
from pipeline.specification.problems import SpecError
from pipeline.store.run import RunDirectory

if TYPE_CHECKING:
    import xarray as xr

_TYPES = {**dict.fromkeys(BRANCH_POINTS, (1, 6)), FOLD: (2, 5), HOPF: (3, 3), DOUBLING: (7, 7), TORUS: (8, 8)}
"""Types of bifurcations of equilibria and maps, and of periodic orbits."""

_END, _FAILED = 9, -9
"""Types of the end of a branch, and of one where no next point was found."""

_SAMPLES = 512
"""Instants of a period at which norms and maxima are taken."""

_AT_ONCE = 256
"""Orbits that are integrated in one call."""

Row = tuple[int, bool, float, Orbit]
"""A point of a branch: its type, whether it is stable, the value of the parameter, and its orbit."""


def branches_text(ds: xr.Dataset) -> str:
    """Return the branches of a run as the text of AUTO's file ``b.NAME``.

    Located bifurcations are points of their branch. Values of the parameter are in the words of the specification.
    """
    run = _run_of(ds)
    plain, shown = with_plain_names(ds), in_own_words(ds)
    base = parameters_of(run.cube())
    name = parameter_name(str(shown.attrs["parameter"]))
    lines, label = [], 0
    for branch in range(plain.sizes["branch"]):
        rows = list(_rows(plain, shown, run, branch))
        is_cycle = bool(plain["orbit_period"].values[branch]) and base.model.clock.is_continuous
        lines += _header(name, [s.name for s in base.model.states], [value for _, _, value, _ in rows], is_cycle)
        numbers = _numbers([orbit for *_, orbit in rows], is_cycle)
        for k, ((kind, stable, value, _), own) in enumerate(zip(rows, numbers, strict=True)):
            label += kind != 0
            head = (-1 if is_cycle else 1) * (branch + 1), (-1 if stable else 1) * (k % 9999 + 1), kind
            lines.append("{:4d}{:6d}{:4d}".format(*head) + f"{label if kind else 0:5d}" + _columns([value, *own]))
    return "\n".join([*lines, ""])


def start_text(ds: xr.Dataset) -> str:
    """Return a time series as the text of AUTO's file ``NAME.dat``: the time, then the states, without quantities."""
    if "time" not in ds.sizes or "model" not in ds.attrs:
        raise SpecError(
            "*.dat: AUTO starts from a time series with states, of magpend.simulate or ds.magpend.orbit; this is none."
        )
    states = [ds[name].values for name in model_of(ds).state_names]
    table = np.column_stack([ds["time"].values - ds["time"].values[0], *states])
    return "".join(" ".join(f"{x:24.16E}" for x in row) + "\n" for row in table)


def orbit(ds: xr.Dataset, branch: int, point: int, samples: int) -> xr.Dataset:
    """Return the orbit at a point of a branch as a time series over one period, as `simulate` returns it."""
    run, plain = _run_of(ds), with_plain_names(ds)
    n_points = plain["n_points"].values
    if not 0 <= branch < len(n_points) or not 0 <= point < n_points[branch]:
        has = f"branch {branch} has {n_points[branch]} points" if 0 <= branch < len(n_points) else ""
        raise SpecError(f"branch = {branch}, point = {point}: {has or f'there are {len(n_points)} branches'}.")
    found = orbit_at(plain, parameters_of(run.cube()), branch, point)
    if not found.period:
        raise SpecError(f"branch = {branch}: has equilibria, which do not move; ds.section has their states.")
    (time,), (states,) = flown([found], samples)
    flow = of_flow(found.parameters)
    values = evaluate([q.name for q in flow.model.quantities], time, states, flow, found.frequency_hz)
    series = labelled(flow, time, "time from a section point on", states, values)
    return series.assign_attrs(frequency_hz=found.frequency_hz, orbit_period=found.period)


def _run_of(ds: xr.Dataset) -> RunDirectory:
    """Return the run in whose directory its branches are kept; raise `SpecError` for any other Dataset."""
    if ds.attrs.get("derived_product") != "branches":
        raise SpecError("AUTO's table, and an orbit by its branch, need the result of branches; this is another one.")
    place, is_kept, _ = str(ds.encoding.get("source", "")).partition("/derived/")
    if not is_kept:
        raise SpecError("the branches were not read from a run directory, so that their parameters are unknown.")
    return RunDirectory.open(place)


def _rows(plain: xr.Dataset, shown: xr.Dataset, run: RunDirectory, branch: int) -> Iterator[Row]:
    """Yield the points of a branch, and after each the bifurcations that were located there."""
    base, n = parameters_of(run.cube()), int(plain["n_points"].values[branch])
    kinds = words_of(plain["kind"])
    is_cycle = bool(plain["orbit_period"].values[branch]) and base.model.clock.is_continuous
    here = np.flatnonzero(plain["of_branch"].values == branch)
    names = {0: "first_end", n - 1: "last_end"}
    ends = {k: words_of(plain[name])[int(plain[name].values[branch])] for k, name in names.items()}
    stable = plain["n_unstable"].values[branch] == 0
    for k in range(n):
        kind = 0 if k not in ends else _FAILED if ends[k] == "stuck" else _END
        yield kind, bool(stable[k]), float(shown["parameter"].values[branch, k]), orbit_at(plain, base, branch, k)
        for i in here[plain["after"].values[here] == k].tolist():
            value, at = float(shown["value"].values[i]), orbit_at_bifurcation(plain, base, i)
            yield _TYPES[kinds[int(plain["kind"].values[i])]][is_cycle], bool(stable[k]), value, at


def _numbers(orbits: Sequence[Orbit], is_cycle: bool) -> Iterator[list[float]]:
    """Yield of each point its L2-norm, and its states; of a periodic orbit their maxima, and the period."""
    if not is_cycle:
        yield from ([float(np.linalg.norm(orbit.state)), *orbit.state.tolist()] for orbit in orbits)
        return
    for k in range(0, len(orbits), _AT_ONCE):
        block = orbits[k : k + _AT_ONCE]
        values = sampled(block, _SAMPLES)[..., : len(block[0].state)]
        norms = np.sqrt((values**2).sum(axis=2).mean(axis=1))
        for one, norm, largest in zip(block, norms.tolist(), highest(values).tolist(), strict=True):
            yield [norm, *largest, one.seconds]


def _header(name: str, states: Sequence[str], values: Sequence[float], is_cycle: bool) -> list[str]:
    columns = [name, "L2-NORM", *(f"MAX {state}" if is_cycle else state for state in states), *["PERIOD"] * is_cycle]
    limits = min(values), max(values), -1e99, 1e99  # of the parameter and of the norm
    return [
        "   0 " + "".join(f"{x:12.4E}" for x in limits),
        "   0   written by magpend, without constants:",
        "   0",
        "   0    PT  TY  LAB " + "".join(f"{column[:18]:^19s}" for column in columns),
    ]


def _columns(values: Sequence[float]) -> str:
    """Return numbers in columns of 19 characters, with three digits of the exponent."""
    parts = (f"{value:.10E}".partition("E") for value in values)
    return "".join(f"{digits}E{int(power):+04d}".rjust(19) for digits, _, power in parts)
