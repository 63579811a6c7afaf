"""Run further values of the swept parameter, or single points of several, in a run beside a run.

`refine` makes the run ``NAME-refined`` with further values. `runs_at` makes a run in the folder ``NAME-points`` for
each point: it has the specification of the run, but for one value on each axis and another number of starts. It has no
products and the usual tasks, neither of which decides the bits of its cells. Its name says the point and the number of
starts, such as ``omega=1.25,F=0.3,n=300``.
"""

from __future__ import annotations

import contextlib
import math
import shutil
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.layout.identity import differences, digest_of, numbered
from pipeline.layout.own_words import spelling_of
from pipeline.layout.plan import Plan, make_plan
from pipeline.layout.vocabulary import parameter_name
from pipeline.runs.extend import exchange, extending_folder, finish_exchange, fitting, folder_aside
from pipeline.runs.run import Echo, Work, carry_out, carry_out_all
from pipeline.runs.zoom import Widening, derived_toml, put_value, widened
from pipeline.specification.models import KEPT
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from pipeline.specification.starts import GridStarts, ListStarts, RandomStarts, put_start
from pipeline.specification.tables import FREQUENCY, RATES, Range
from pipeline.store.errors import DamagedError, RefusedError, StoreError
from pipeline.store.files import RECORD_COPY
from pipeline.store.objects import open_files
from pipeline.store.run import RunDirectory
from pipeline.store.runfile import is_run

if TYPE_CHECKING:
    from pipeline.compute.clients import Where

AT_ONCE = 100
"""Runs whose tasks are shared by the workers at one time, each with its lock, which is an open file."""

Point = Mapping[str, float]


# ---- further values ----------------------------------------------------------------------------


def refine(
    source: str | Path | RunDirectory,
    values: Sequence[float],
    *,
    workers: int | None = None,
    where: Where | None = None,
    echo: Echo = print,
) -> RunDirectory:
    """Return the run beside a run that also has further values of its swept parameter, and compute what that lacks.

    The run beside has the name ``NAME-refined``, the specification of the run with all further values so far, and the
    bytes that a run of this specification from nothing has. Cells are copied where that is possible: in a continuation
    up to the first further value. If it is killed at any moment, the next call completes it.

    Parameters
    ----------
    source
        Run directory, or an opened run; it is only read.
    values
        Further values, a frequency in Hz. Without any, the result is the run beside as it is, completed; the run itself
        if there is none.
    workers, where, echo
        See `pipeline.runs.run.carry_out`.

    Raises
    ------
    SpecError
        If the run does not sweep one parameter alone.
    RefusedError
        If ``NAME-refined`` exists and is another run.
    """
    run = RunDirectory.open(source)
    place = _place_of_further(run)
    ((key, axis),) = run.spec.axes.items()
    finish_exchange(place, echo)
    own = axis.given()
    how: dict[str, Any] = {"workers": workers, "where": where, "echo": echo}
    more = RATES[run.spec.rate].given(np.array(values)) if key == FREQUENCY else np.array(values)
    if not is_run(open_files(place)):
        return _refined(run, np.union1d(own, more), place, (), **how) if len(more) else run
    old = RunDirectory.open(place)
    had = old.spec.axes[key].given()
    if not set(own.tolist()) <= set(had.tolist()) or _but_axes(old.spec) != _but_axes(run.spec):
        raise RefusedError(f"{place}: exists, and is not {run.name} with further values of {key}; move it away.")
    if not old.complete:
        old = _refined(run, had, place, (), **how)
    wanted = np.union1d(had, more)
    if len(wanted) == len(had):
        return old
    aside = folder_aside(place)
    _refined(run, wanted, extending_folder(place), (old,), **how)
    exchange(place, extending_folder(place), lambda line: None)
    shutil.rmtree(aside)
    return RunDirectory.open(place)


def _place_of_further(run: RunDirectory) -> Path:
    """Return the folder of a run's further values; raise SpecError or RefusedError if it can have none."""
    if len(run.spec.axes) != 1:
        raise SpecError(
            f"{run.name}: sweeps {', '.join(run.spec.axes) or 'nothing'}, and further values are those of one swept "
            "parameter; make a run that sweeps one: magpend zoom."
        )
    if run.info.files.local is None:
        raise RefusedError(f"{run.name}: further values are run in a folder beside it; copy the run to this machine.")
    folder = run.info.files.local.resolve()
    return folder.with_name(f"{folder.name}-refined")


def _but_axes(spec: Spec) -> Mapping[str, Any]:
    return {name: table for name, table in spec.as_dict().items() if name != "axes"}


def _refined(
    run: RunDirectory,
    values: np.ndarray,
    place: Path,
    others: Sequence[RunDirectory],
    *,
    workers: int | None,
    where: Where | None,
    echo: Echo,
) -> RunDirectory:
    """Compute a run with other values of its swept parameter in a folder; cells of the run and of others are copied."""
    from pipeline.compute.clients import Where

    (key,) = run.spec.axes
    word = run.spec.rate if key == FREQUENCY else key
    spec = widened(run.spec, Widening({word: {"values": values.tolist()}}))
    text = derived_toml("Refined", f"run {run.info.name}, digest {run.info.digest}", spec)
    plan = make_plan(spec, text)
    files = open_files(place)
    if is_run(files) and RunDirectory.open(files).info.digest != digest_of(plan.identity):
        shutil.rmtree(place)  # left by a refinement that was killed
    fit, _ = fitting([*others, run], plan)
    sources = [(one.info.files.place, one.info.digest) for one in fit]
    there = replace(where or Where(), place=files.place)
    carry_out(plan, files, workers=workers, where=there, echo=echo, sources=sources)
    return RunDirectory.open(place)


# ---- single points -----------------------------------------------------------------------------


def runs_at(
    run: RunDirectory,
    points: Sequence[Point],
    n_starts: int | Sequence[int],
    *,
    workers: int | None = None,
    where: Where | None = None,
    echo: Echo = print,
) -> list[RunDirectory]:
    """Return the runs beside a run at single points of its swept parameters, and compute what they lack.

    A cell has the bits that the run's own cell at this point and start has. Cells that the run, or another run of its
    points, has are copied. The workers share the tasks of all points. If this is killed at any moment, the next call
    completes what is there, with the same bytes; a complete run is opened.

    Parameters
    ----------
    run
        A sweep; it is only read.
    points
        A value for each swept parameter by its name. The drive's rate may be given as ``frequency_hz``, ``omega`` or
        ``period``; the coordinate ``frequency`` of a cube is in Hz.
    n_starts
        Number of starts, of all points or of each. Random starts are then as many, of the same seed: the first ones are
        those of the run, except in a latin hypercube, where all are others. Each range of a grid is divided in as few
        parts as make at least this number; the run's own starts are among them. A list of states and a single state
        stay as they are, and have no more starts.
    workers, where, echo
        See `pipeline.runs.run.carry_out`.

    Raises
    ------
    SpecError
        If a point has no value for each axis, or a bad one; if the run is a continuation, whose cells begin where their
        neighbours end; if its starts are fewer than `n_starts` and no recipe makes more.
    RefusedError
        If the run is not in a folder of this machine, or a folder has the name of a point's run and holds another one.
    """
    from pipeline.compute.clients import Where

    beside = _folder_of_points(run)
    counts = [n_starts] * len(points) if isinstance(n_starts, int) else n_starts
    places: list[Path] = []
    plans: dict[Path, Plan] = {}
    for point, n in zip(points, counts, strict=True):
        place, plan = _planned(run, point, n)
        places.append(beside / place)
        plans.setdefault(places[-1], plan)
    found = {place: _kept(run, place, plan) for place, plan in plans.items()}
    rest = [place for place, one in found.items() if one is None]
    others = _others(beside)
    for k in range(0, len(rest), AT_ONCE):
        some = rest[k : k + AT_ONCE]
        works = [Work(plans[p], open_files(p), _sources(run, others[_point_of(p)], plans[p])) for p in some]
        there = replace(where or Where(), place=works[0].files.place)
        carry_out_all(works, workers=workers, where=there, echo=echo)
    return [found[place] or RunDirectory.open(place) for place in places]


# ---- specification of a point -----------------------------------------------------------------------------


def _planned(run: RunDirectory, point: Point, n_starts: int) -> tuple[str, Plan]:
    """Return the name and the plan of the run at one point."""
    values = _values(run, point)
    starts, n = _starts(run, n_starts)
    data = {**run.spec.as_dict(), "initial_conditions": starts, "products": {}, "execution": {}}
    for word, value in values.items():
        put_value(run.spec, data, word, {"values": [value]})
    spec = Spec.parse(data, KEPT)
    origin = f"run {run.info.directory.resolve().name}, digest {run.info.digest}"
    name = ",".join([*(f"{word}={value!r}" for word, value in values.items()), f"n={n}"])
    return name, make_plan(spec, derived_toml("One point", origin, spec))


def _values(run: RunDirectory, point: Point) -> dict[str, float]:
    """Return a point's value on each axis of a run, in the words of its specification."""
    spec = run.spec
    words = {name: spec.rate if name == FREQUENCY else name for name in spec.axes}
    given = {parameter_name(spelling_of(name, spec.model)[0]): (name, float(value)) for name, value in point.items()}
    if given.keys() != words.keys() or len(given) != len(point):
        told = ", ".join(f"{name} = {value!r}" for name, value in point.items()) or "no value"
        wanted = ", ".join(words.values()) or "no other; the run sweeps nothing"
        raise SpecError(f"{run.name}: a point has {told}; give one value for each of {wanted}.")
    return {word: _in_word(spec, axis, *given[axis]) for axis, word in words.items()}


def _in_word(spec: Spec, axis: str, name: str, value: float) -> float:
    """Return a value of an axis in the word of a specification; the axis' own value where the cells' is the same."""
    if axis != FREQUENCY or name == spec.rate:
        return value
    rate, own = RATES[spec.rate], spec.axes[axis].given()
    hertz = float(spelling_of(name, spec.model)[1](value))
    same = own[rate.hertz(own) == hertz]
    return float(same[0] if len(same) else rate.given(hertz))


def _starts(run: RunDirectory, n_starts: int) -> tuple[dict[str, Any], int]:
    """Return the table of initial conditions with another number of starts, and the number."""
    starts, n = run.spec.initial_conditions, math.prod(run.plan.cells.states.shape)
    if run.spec.continuation is not None:
        raise SpecError(
            f"{run.name}: is a continuation, whose cells begin where their neighbours end, and has no cells of one "
            'point alone; begin a run with kind = "sweep".'
        )
    if isinstance(starts, RandomStarts):
        return {**starts.plain(), "n": n_starts}, n_starts
    if n >= n_starts:
        return starts.plain(), n
    lengths = [axis.n for axis in starts.ranges.values()] if isinstance(starts, GridStarts) else []
    if not any(length > 1 for length in lengths):
        what = f"a list of {n}" if isinstance(starts, ListStarts) else "one state"
        raise SpecError(
            f"{run.name}: initial_conditions: {n_starts} starts at a point are wanted, and {what} gives no more; begin "
            'a run with random starts (kind = "random") or with a range of a state.'
        )
    parts = next(k for k in count(2) if math.prod((m - 1) * k + 1 for m in lengths) >= n_starts)
    assert isinstance(starts, GridStarts)
    table = starts.plain()
    for key, axis in starts.ranges.items():
        put_start(table, key, _divided(axis, parts), starts)
    return table, math.prod((m - 1) * parts + 1 for m in lengths)


def _divided(axis: Range, parts: int) -> dict[str, Any]:
    """Return a range with each interval divided in equal parts; its own values stay, to the last bit."""
    if axis.values is None:
        last = axis.stop if axis.num is not None else float(axis.given()[-1])
        return {"start": axis.start, "stop": last, "num": (axis.n - 1) * parts + 1} if axis.n > 1 else axis.model_dump()
    own = axis.given()
    between = own[:-1, None] + np.diff(own)[:, None] * np.arange(parts) / parts
    return {"values": [*between.ravel().tolist(), float(own[-1])]}


# ---- folders of points -----------------------------------------------------------------------------------


def _folder_of_points(run: RunDirectory) -> Path:
    """Return the folder of a run's points; raise RefusedError if it can have none."""
    if run.info.files.local is None:
        raise RefusedError(f"{run.name}: single points are run in a folder beside it; copy the run to this machine.")
    folder = run.info.files.local.resolve()
    return folder.with_name(f"{folder.name}-points")


def _point_of(place: Path) -> str:
    """Return the part of the name of a point's run that says the point."""
    return place.name.rpartition(",")[0]


def _others(folder: Path) -> Mapping[str, list[Path]]:
    """Return the runs in the folder of a run's points, by point."""
    found: dict[str, list[Path]] = defaultdict(list)
    for place in sorted(folder.glob("*n=*")):
        found[_point_of(place)].append(place)
    return found


def _kept(run: RunDirectory, place: Path, plan: Plan) -> RunDirectory | None:
    """Return the finished run of a plan in a folder; None if there is none; raise RefusedError for another run."""
    if not is_run(open_files(place)):
        return None
    try:
        kept = RunDirectory.open(place)
    except DamagedError:
        return None
    if kept.info.digest != digest_of(plan.identity):
        lines = differences(numbered(kept.info.identity), plan.identity)
        raise RefusedError(
            f"{place}: exists, and is not {run.name} at this point; move it away. Differences:\n  " + "\n  ".join(lines)
        )
    return kept if kept.complete and kept.info.files.is_there(RECORD_COPY) else None


def _sources(run: RunDirectory, places: Sequence[Path], plan: Plan) -> list[tuple[str, str]]:
    """Return the directories and digests of the runs from which the cells of a plan are copied: those of the same
    point, and the run if it has the point.
    """
    runs = []
    for place in places:
        with contextlib.suppress(StoreError):
            runs.append(RunDirectory.open(place))
    pairs = zip(plan.cells.axes, run.plan.cells.axes, strict=True)
    if all(np.isin(one.values, own.values).all() for one, own in pairs):
        runs.append(run)
    fit, _ = fitting(runs, plan)
    return [(one.info.files.place, one.info.digest) for one in fit]
