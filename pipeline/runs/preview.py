"""Describe a run before it starts, and choose the figure that shows its result best."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pipeline.layout.domains import check_starts
from pipeline.layout.limits import check_space
from pipeline.layout.plan import Plan, make_plan
from pipeline.layout.units import unit_remarks
from pipeline.layout.vocabulary import is_grid_dim, is_start_dim
from pipeline.runs.estimate import estimate, wall_seconds, writing_seconds
from pipeline.runs.noise import check_steps
from pipeline.runs.progress import duration, size
from pipeline.runs.run import identity_here
from pipeline.runs.workflows import default_directory, find_spec
from pipeline.specification.parsing import Spec, load_spec
from pipeline.store.commits import read_commits
from pipeline.store.places import open_files
from pipeline.store.run import Run
from pipeline.store.setup import check

MANY_SECTIONS = 500
"""Fewest kept sections for which the section of a single parameter point is drawn."""


def first_figure(plan: Plan) -> str:
    """Return the name of the figure that gives the best overview of a run."""
    n_swept, n_grid = _long(plan)
    if plan.is_recorded:  # its cells cannot be integrated further, so it has no attractors to draw
        return "bifurcation" if n_swept else "section"
    if any(v.name == "lyapunov" for v in plan.variables):
        return "lyapunov" if n_swept else "convergence"
    if n_swept >= 2:
        return "regimes"
    if n_swept == 1:
        return "bifurcation"
    if n_grid >= 2:
        return "basins"
    if plan.sizes.get("period_index", 0) >= MANY_SECTIONS:
        return "section"
    return "bifurcation" if any(not is_start_dim(d) for d in plan.dims) else "gallery"


def figure_command(plan: Plan, directory: str | Path) -> str:
    """Return the ``magpend plot`` command that draws the best overview of a run."""
    name = first_figure(plan)
    as_map = name == "lyapunov" and _long(plan)[0] >= 2
    return f"magpend plot {name} {directory}" + (" --map" if as_map else "")


def _long(plan: Plan) -> tuple[int, int]:
    """Count the axes with more than one value: swept parameters, and axes of initial conditions."""
    long = [d for d, n in zip(plan.dims, plan.shape, strict=True) if n > 1]
    return sum(not is_start_dim(d) for d in long), sum(is_grid_dim(d) for d in long)


def shown(run: Run) -> tuple[str, dict[str, Any], str]:
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
    plan, cube = run.plan, run.cube()
    name = first_figure(plan)
    options: dict[str, Any] = {}
    sizes = {d: n for d, n in zip(plan.dims, plan.shape, strict=True) if n > 1 and not is_start_dim(d)}
    swept = list(sizes)
    as_map = name == "lyapunov" and len(swept) >= 2
    if name == "regimes":  # a map of regimes would ask for an analysis, which may take long
        name = "bifurcation"
    if len(swept) >= 2:
        options["at"] = {d: float(cube[d].values[sizes[d] // 2]) for d in swept[2 if as_map else 1 :]}
    left = [f"{d} is drawn at {v:.6g}, one of {sizes[d]} values" for d, v in options.get("at", {}).items()]
    more = f"magpend plot {first_figure(plan)} {run.name}"
    if as_map:
        options["as_map"] = True
        left.append("the sections are not in the map")
        more = f"magpend plot bifurcation {run.name} --at " + " --at ".join(f"{d}=VALUE" for d in swept[1:])
    elif name == "lyapunov" and cube.sizes.get("exponent", 1) > 1:
        left.append("all exponents but the largest")
        more += " --spectrum"
    return name, options, f"left out: {'; '.join(left)}. See: {more}" if left else ""


def describe_plan(
    spec: str | Path, out: str | Path | None, *, workers: int | None = None, smoke: bool = False
) -> Iterator[str]:
    """Yield the text lines that a dry run prints; nothing but the compile cache is written.

    The time is measured on some of the run's own cells, after the lines that cost nothing.

    Raises
    ------
    SpecError, RefusedError
        See `pipeline.runs.run.run`.
    """
    path = find_spec(spec)
    parsed = load_spec(path, smoke=smoke)
    check_starts(parsed)
    check_steps(parsed)
    files = open_files(out if out is not None else default_directory(path, smoke))
    plan = make_plan(parsed)
    info = check(files, identity_here(parsed, plan))
    done = read_commits(info, plan) if info else {}
    check_space(plan, files.local, plan.n_cells - sum(plan.cells_in(i) for i in done))
    if parsed.title:
        yield parsed.title
    yield from (f"warning: {remark}" for remark in (*parsed.model.flow.remarks, *unit_remarks(parsed.model)))
    dims = ", ".join(f"{d} {n}" for d, n in zip(plan.dims, plan.shape, strict=True))
    yield f"{parsed.kind}: {plan.n_cells} cells ({dims or 'one cell'})"
    yield f"tasks: {plan.n_tasks} of {' x '.join(map(str, plan.block)) or '1'} cells, {len(done)} done"
    yield f"cube: {size(plan.n_bytes)} before compression"
    yield f"directory: {files.name}" + ("" if info else " (not created)")
    missing = set(range(plan.n_tasks)) - set(done)
    share = sum(plan.cells_in(i) for i in missing) / plan.n_cells
    yield time_line(parsed, plan, share, len(missing), workers)


def time_line(spec: Spec, plan: Plan, share: float, n_tasks: int, workers: int | None) -> str:
    """Return a text line with the estimated time for a fraction `share` of a run's cells."""
    from pipeline.compute.execute import default_workers

    if not share:
        return "time: nothing is left to compute"
    found = estimate(spec, plan)
    writing_s = writing_seconds(spec, plan)
    seconds = share * found.core_seconds + n_tasks * writing_s
    used = default_workers() if workers is None else workers
    cores, by_clock = max(1, min(used, n_tasks)), wall_seconds(seconds, n_tasks, used)
    bound = "about" if spec.refine is None else "at most"
    compiled = f"; compiling its kernel took {duration(found.compiled_s)}" if found.compiled_s > 1 else ""
    whole = duration(found.core_seconds)
    rests = f"{found.how}; writing a task takes {1000 * writing_s:.0f} ms{compiled}"
    more = (
        f"; after it, analyse attractors may extend cells for up to {whole} of one core" if spec.noise is None else ""
    )
    return f"time: {bound} {duration(seconds)} of one core, {duration(by_clock)} on {cores} ({rests}){more}"
