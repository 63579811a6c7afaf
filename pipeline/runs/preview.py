"""Describe a run before it starts, and choose the figure that shows its result best."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pipeline.layout.conventions import unit_remarks
from pipeline.layout.extents import size_remarks
from pipeline.layout.own_words import dims_in_own_words
from pipeline.layout.plan import Plan, check_space
from pipeline.layout.vocabulary import is_grid_dim, is_start_dim
from pipeline.products.registry import FIGURES
from pipeline.runs.estimate import estimate, wall_seconds, writing_seconds
from pipeline.runs.methods import decided
from pipeline.runs.progress import duration, size
from pipeline.runs.run import prepare
from pipeline.runs.suitability import overview, unsuited
from pipeline.specification.spec import Spec
from pipeline.specification.starts import start_remarks
from pipeline.store.checking import whole_records
from pipeline.store.objects import open_files
from pipeline.store.run import RunDirectory
from pipeline.store.setup import check

MANY_SECTIONS = 500
"""Fewest kept sections for which the section of a single parameter point is drawn."""


def first_figure(run: RunDirectory) -> str:
    """Return the name of the figure that gives the best overview of a run; the run can draw it."""
    plan = run.plan
    swept, grid = _long(plan)
    if name := overview(run.spec.motion, is_swept=bool(swept)):
        return name
    if any(v.name == "lyapunov" for v in plan.variables):
        return "lyapunov" if swept else "convergence"
    if len(swept) >= 2:
        return "regimes"
    if swept:
        return "bifurcation"
    if len(grid) >= 2:
        return "basins"
    if plan.sizes.get("period_index", 0) >= MANY_SECTIONS:
        return "section"
    if any(not is_start_dim(d) for d in plan.dims):
        return "bifurcation"
    return "section" if unsuited(run.spec.motion, FIGURES["gallery"]) else "gallery"


def figure_command(run: RunDirectory) -> str:
    """Return the ``magpend plot`` command that draws the best overview of a run."""
    name, options = needed(run)
    points = "".join(f" --at {axis}={value:.10g}" for axis, value in options.get("at", {}).items())
    return f"magpend plot {name} {run.name}" + (" --map" if "as_map" in options else "") + points


def needed(run: RunDirectory, name: str = "") -> tuple[str, dict[str, Any]]:
    """Return the name of a figure, by default `first_figure`, and the options without which it cannot show the run: a
    value in the middle of each axis that it has not.
    """
    name = name or first_figure(run)
    (swept, grid), options = _long(run.plan), dict[str, Any]()
    as_map = name == "lyapunov" and len(swept) >= 2
    if as_map:
        options["as_map"] = True
    left = [*swept[2 if as_map or name == "regimes" else 1 :], *(grid[2:] if name == "basins" else ())]
    if left:
        cube = run.cube()
        options["at"] = {d: float(cube[d].values[cube.sizes[d] // 2]) for d in left}
    return name, options


def _long(plan: Plan) -> tuple[list[str], list[str]]:
    """Return the axes with more than one value: swept parameters, and axes of initial conditions."""
    long = [d for d, n in zip(plan.dims, plan.shape, strict=True) if n > 1]
    return [d for d in long if not is_start_dim(d)], [d for d in long if is_grid_dim(d)]


def shown(run: RunDirectory) -> tuple[str, dict[str, Any], str]:
    """Return the figure that ``magpend run --plot`` draws: its name, its options, and a note on what it leaves out.

    Returns
    -------
    name : str
        Name of the figure.
    options : dict
        Options of the figure.
    left_out : str
        Sentence on the parts of the run that are not drawn, with the command that draws them; else empty.
    """
    name = first_figure(run)
    # a map of regimes would ask for an analysis, which may take long
    name, options = needed(run, "bifurcation" if name == "regimes" else name)
    sizes = dict(zip(run.plan.dims, run.plan.shape, strict=True))
    left = [f"{d} is drawn at {v:.6g}, one of {sizes[d]} values" for d, v in options.get("at", {}).items()]
    more = figure_command(run)
    if "as_map" in options:
        left.append("the sections are not in the map")
        more = f"magpend plot bifurcation {run.name} --at " + " --at ".join(
            f"{d}=VALUE" for d in _long(run.plan)[0][1:]
        )
    elif name == "lyapunov" and run.cube().sizes.get("exponent", 1) > 1:
        left.append("all exponents but the largest")
        more += " --spectrum"
    return name, options, f"left out: {'; '.join(left)}. See: {more}" if left else ""


@dataclass(frozen=True)
class Times:
    """Estimated time of the missing cells of a run.

    Attributes
    ----------
    core_seconds : float
        Time on one core [s].
    wall_seconds : float
        Time on the chosen number of workers [s].
    line : str
        Text line with both, and what they rest on.
    """

    core_seconds: float
    wall_seconds: float
    line: str


@dataclass(frozen=True, repr=False)
class Preview:
    """Description of a run before it starts; its text is what ``magpend run --dry-run`` prints.

    Attributes
    ----------
    plan : Plan
        The specification, with the tasks and arrays that follow from it.
    directory : str
        Place of the run.
    exists : bool
        Whether the run has been created.
    done : frozenset of int
        Committed tasks.
    workers : int or None
        Number of workers that the time is for; None for the cores of this machine.
    """

    plan: Plan
    directory: str
    exists: bool
    done: frozenset[int]
    workers: int | None = None

    @property
    def spec(self) -> Spec:
        """The specification, checked."""
        return self.plan.spec

    @property
    def dims(self) -> dict[str, int]:
        """Number of values along each axis of the run."""
        return dict(zip(self.plan.dims, self.plan.shape, strict=True))

    @property
    def n_cells(self) -> int:
        """Number of cells of the run."""
        return self.plan.n_cells

    @property
    def n_tasks(self) -> int:
        """Number of tasks of the run."""
        return self.plan.n_tasks

    @property
    def n_bytes(self) -> int:
        """Size of the result cube before compression [bytes]."""
        return self.plan.n_bytes

    @cached_property
    def _decision(self) -> tuple[Plan, list[str]]:
        told: list[str] = []
        return decided(self.plan, told.append), told

    @property
    def decided(self) -> Plan:
        """The plan with the method of the run, which may be decided at the first use."""
        return self._decision[0]

    @cached_property
    def times(self) -> Times:
        """Time of the missing cells, measured on some of them at the first use."""
        missing = set(range(self.n_tasks)) - self.done
        share = sum(self.plan.cells_in(i) for i in missing) / self.n_cells
        return times(self.decided, share, len(missing), self.workers)

    @property
    def lines(self) -> Iterator[str]:
        """Text lines of a dry run; the last one has the time."""
        if self.spec.title:
            yield self.spec.title
        yield from (f"warning: {remark}" for remark in (*self.spec.model.flow.remarks, *unit_remarks(self.spec.model)))
        names = dims_in_own_words(self.dims, self.spec.rate)
        dims = ", ".join(f"{d} {n}" for d, n in zip(names, self.dims.values(), strict=True))
        yield f"{self.spec.kind}: {self.n_cells} cells ({dims or 'one cell'})"
        block = " x ".join(map(str, self.plan.block)) or "1"
        yield from start_remarks(self.spec.initial_conditions)
        yield from size_remarks(self.spec)
        yield f"tasks: {self.n_tasks} of {block} cells, {len(self.done)} done"
        yield f"cube: {size(self.n_bytes)} before compression"
        yield f"directory: {self.directory}" + ("" if self.exists else " (not created)")
        yield from self._decision[1]
        yield self.times.line

    def __repr__(self) -> str:
        return "\n".join(self.lines)


def preview(
    spec: str | Path | Mapping[str, Any] | Spec,
    out: str | Path | None = None,
    *,
    workers: int | None = None,
    smoke: bool = False,
) -> Preview:
    """Describe a run before it starts; nothing but the compile cache is written.

    Parameters
    ----------
    spec, out, workers, smoke
        See `pipeline.runs.run.run`.

    Raises
    ------
    SpecError, RefusedError
        See `pipeline.runs.run.run`.
    """
    parsed = Spec.read(spec, smoke=smoke)
    files = open_files(out if out is not None else parsed.directory)
    plan = prepare(parsed, files)
    info = check(files, plan.identity)
    done = whole_records(info) if info else set()
    check_space(plan, files.local, plan.n_cells - sum(plan.cells_in(i) for i in done))
    return Preview(plan, files.name, info is not None, frozenset(done), workers)


def describe_plan(
    spec: str | Path | Mapping[str, Any] | Spec,
    out: str | Path | None,
    *,
    workers: int | None = None,
    smoke: bool = False,
) -> Iterator[str]:
    """Yield the text lines that a dry run prints, the measured time last. See `preview`."""
    yield from preview(spec, out, workers=workers, smoke=smoke).lines


def time_line(plan: Plan, share: float, n_tasks: int, workers: int | None) -> str:
    """Return a text line with the estimated time for a fraction `share` of a run's cells."""
    return times(plan, share, n_tasks, workers).line


def times(plan: Plan, share: float, n_tasks: int, workers: int | None) -> Times:
    """Estimate the time for a fraction `share` of a run's cells, in `n_tasks` tasks."""
    from pipeline.compute.execute import default_workers

    if not share:
        return Times(0.0, 0.0, "time: nothing is left to compute")
    found, writing_s = estimate(plan), writing_seconds(plan)
    seconds = share * found.core_seconds + n_tasks * writing_s
    used = default_workers() if workers is None else workers
    cores, by_clock = max(1, min(used, n_tasks)), wall_seconds(seconds, n_tasks, used)
    bound = "about" if plan.spec.refine is None else "at most"
    compiled = f"; compiling its kernel took {duration(found.compiled_s)}" if found.compiled_s > 1 else ""
    whole = duration(found.core_seconds)
    rests = f"{found.how}; writing a task takes {1000 * writing_s:.0f} ms{compiled}"
    more = (
        ""
        if plan.spec.motion.obstacle
        else f"; after it, analyse attractors may extend cells for up to {whole} of one core"
    )
    line = f"time: {bound} {duration(seconds)} of one core, {duration(by_clock)} on {cores} ({rests}){more}"
    return Times(seconds, by_clock, line)
