"""Glue: a specification's file to a finished run directory, and what stands in one."""

from __future__ import annotations

import contextlib
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

from pipeline.layout.identity import identity_of
from pipeline.layout.plan import Plan, make_plan
from pipeline.layout.vocabulary import is_grid_dim, is_start_dim
from pipeline.runs.progress import Progress, duration, size
from pipeline.spec.parsing import Spec, load_spec, parse_spec
from pipeline.spec.problems import SpecError
from pipeline.store import directory as store

Echo = Callable[[str], None]


class InterruptedRunError(Exception):
    """The run was stopped by a signal; what was committed stays.

    Attributes
    ----------
    signal_number : int
    """

    def __init__(self, signal_number: int, message: str) -> None:
        self.signal_number = signal_number
        super().__init__(message)


class _Terminated(KeyboardInterrupt):
    """SIGTERM, treated like Ctrl-C."""


@dataclass(frozen=True)
class State:
    """How far a run is.

    Attributes
    ----------
    directory : Path
    title : str
    plan : Plan
    done : frozenset of int
        Committed tasks.
    cells : dict
        Committed cells by status name.
    """

    directory: Path
    title: str
    plan: Plan
    done: frozenset[int]
    cells: dict[str, int] = field(default_factory=dict)

    @property
    def n_committed(self) -> int:
        """Committed cells."""
        return sum(self.cells.values())

    @property
    def complete(self) -> bool:
        """Whether every task is committed."""
        return len(self.done) == self.plan.n_tasks


def find_spec(name: str | Path) -> Path:
    """Return the path of a specification: a file, or the bare name of a shipped workflow.

    Raises
    ------
    SpecError
        If there is neither.
    """
    path = Path(name)
    if path.exists() or path.suffix or len(path.parts) > 1:
        return path
    shipped = shipped_workflows()
    if str(name) in shipped:
        return shipped[str(name)]
    known = f"shipped workflows: {', '.join(shipped)}" if shipped else "no workflows are shipped"
    raise SpecError([f"{name}: no such file, and no shipped workflow of that name ({known})."])


def shipped_workflows() -> dict[str, Path]:
    """Paths of the workflows that ship with magpend, by name."""
    try:
        folder = Path(str(resources.files("workflows")))
    except ModuleNotFoundError:
        return {}
    return {p.stem: p for p in sorted(folder.glob("*.toml"))}


def default_directory(spec_path: Path, smoke: bool) -> Path:
    """Where a run goes unless told otherwise."""
    return Path("runs") / (spec_path.stem + ("-smoke" if smoke else ""))


def run(
    spec: str | Path,
    out: str | Path | None = None,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    smoke: bool = False,
    echo: Echo = print,
) -> State:
    """Run a specification, or what is missing of it.

    Parameters
    ----------
    spec
        Path of a TOML file, or the name of a shipped workflow.
    out
        Run directory; by default ``runs/<name>``.
    workers, scheduler
        See `execute.run_tasks`.
    smoke
        Take the small size of the specification's ``[smoke]`` table.
    echo
        Prints a line.

    Returns
    -------
    State
        Of the finished run.

    Raises
    ------
    SpecError, store.RefusedError, store.LockedError
        Before anything is created or changed.
    execute.TaskFailedError
        If a task failed. What was committed stays.
    InterruptedRunError
        After Ctrl-C or SIGTERM. What was committed stays.
    """
    path = find_spec(spec)
    parsed = load_spec(path, smoke=smoke)
    directory = Path(out) if out is not None else default_directory(path, smoke)
    plan = make_plan(parsed)
    identity = _identity(parsed, plan)
    store.check(directory, identity)
    with store.writer_lock(directory):
        info = store.check(directory, identity)
        if info is None:
            info = store.create(directory, parsed, plan, identity, path.read_text("utf-8"))
        with _stoppable(directory):
            _complete(info, parsed, plan, workers, scheduler, echo)
    return state(directory)


def _identity(spec: Spec, plan: Plan) -> dict[str, Any]:
    from magpend_core import kernel_version

    return identity_of(spec, plan, kernel_version())


def _complete(
    info: store.RunInfo, spec: Spec, plan: Plan, workers: int | None, scheduler: str | None, echo: Echo
) -> None:
    """Compute all tasks without a valid marker."""
    from pipeline.compute import execute, task

    commits = store.read_commits(info, plan)
    store.sweep(info, commits)
    missing = [i for i in range(plan.n_tasks) if i not in commits]
    if not missing:
        echo(f"{info.directory} is complete; nothing to do.")
        return
    before = plan.n_cells - sum(plan.cells_in(i) for i in missing)
    echo(
        f"{plan.n_cells} cells in {plan.n_tasks} tasks" + (f", {before} cells done before" if before else "")
    )
    seconds = task.warm_up(spec)
    if seconds > 1:
        echo(f"kernel compiled in {duration(seconds)}")
    job = partial(task.run_task, str(info.directory.absolute()), info.digest)
    started = time.perf_counter()
    with Progress(plan.n_cells, before, terminal=sys.stdout.isatty(), echo=echo) as progress:
        for result in execute.run_tasks(job, missing, workers=workers, scheduler=scheduler):
            store.log_timing(info.directory, {**result, "at_s": round(time.perf_counter() - started, 4)})
            progress.add(result["cells"])


@contextlib.contextmanager
def _stoppable(directory: Path) -> Iterator[None]:
    """Turn Ctrl-C and SIGTERM into `InterruptedRunError`, after everything inside has been closed."""

    def stop(number: int, frame: Any) -> None:
        raise _Terminated

    try:
        before = signal.signal(signal.SIGTERM, stop)
    except ValueError:  # not the main thread: signals are somebody else's
        before = None
    try:
        yield
    except KeyboardInterrupt as error:
        number = signal.SIGTERM if isinstance(error, _Terminated) else signal.SIGINT
        message = f"Stopped. What is committed in {directory} stays; the same command goes on from there."
        raise InterruptedRunError(number, message) from None
    finally:
        if before is not None:
            signal.signal(signal.SIGTERM, before)


def state(directory: str | Path) -> State:
    """Say how far a run is, from its markers alone."""
    info = store.read_run(Path(directory))
    plan = make_plan(parse_spec(info.spec))
    commits = store.read_commits(info, plan)
    cells: Counter[str] = Counter()
    for commit in commits.values():
        cells.update(commit.status)
    return State(info.directory, info.title, plan, frozenset(commits), dict(cells))


def first_figure(plan: Plan) -> str:
    """Name of the figure of ``magpend plot`` that shows a run as a whole."""
    swept = [d for d in plan.dims if not is_start_dim(d)]
    long = [d for d, n in zip(plan.dims, plan.shape, strict=True) if n > 1]
    n_swept, n_grid = sum(d in swept for d in long), sum(is_grid_dim(d) for d in long)
    if n_swept >= 2:
        return "regimes"
    if n_swept == 0 and n_grid >= 2:
        return "basins"
    return "bifurcation" if swept else "gallery"


def check_diagram(spec: str | Path, *, smoke: bool = False) -> None:
    """Refuse a specification whose run is not drawn as a bifurcation diagram.

    Raises
    ------
    SpecError
        Naming the figure that is.
    """
    figure = first_figure(make_plan(load_spec(find_spec(spec), smoke=smoke)))
    if figure != "bifurcation":
        raise SpecError(
            [
                "--plot: a bifurcation diagram is drawn over one parameter; drop it, "
                f"and use: magpend plot {figure} DIR"
            ]
        )


def describe_plan(
    spec: str | Path, out: str | Path | None, *, workers: int | None = None, smoke: bool = False
) -> list[str]:
    """Return the lines of a dry run; creates nothing.

    Raises
    ------
    SpecError, store.RefusedError
        As `run` would.
    """
    from pipeline.compute.execute import default_workers

    path = find_spec(spec)
    parsed = load_spec(path, smoke=smoke)
    directory = Path(out) if out is not None else default_directory(path, smoke)
    plan = make_plan(parsed)
    info = store.check(directory, _identity(parsed, plan))
    done = store.read_commits(info, plan) if info else {}
    cores = max(1, min(default_workers() if workers is None else workers, plan.n_tasks))
    dims = ", ".join(f"{d} {n}" for d, n in zip(plan.dims, plan.shape, strict=True))
    title = [parsed.title] if parsed.title else []
    return title + [
        f"{parsed.kind}: {plan.n_cells} cells ({dims or 'one cell'})",
        f"tasks: {plan.n_tasks} of {' x '.join(map(str, plan.block)) or '1'} cells, {len(done)} done",
        f"cube: {size(plan.n_bytes)} before compression",
        f"time: {'about' if parsed.refine is None else 'at most'} {duration(plan.core_seconds)} of one core, "
        f"{duration(plan.core_seconds / cores)} on {cores} (a rule of thumb; "
        "orbits that close early end sooner)",
        f"directory: {directory}" + ("" if info else " (not created)"),
    ]


def describe_state(found: State) -> list[str]:
    """Return the lines of ``magpend status``."""
    plan = found.plan
    share = 100 * found.n_committed / plan.n_cells
    lines = [found.title] if found.title else []
    lines += [
        f"{found.directory}: {'complete' if found.complete else 'incomplete'}",
        f"committed: {found.n_committed} of {plan.n_cells} cells ({share:.1f} %), "
        f"{len(found.done)} of {plan.n_tasks} tasks",
    ]
    return lines + _status_lines(found.cells, plan.n_cells - found.n_committed)


def _status_lines(cells: Mapping[str, int], pending: int) -> list[str]:
    from magpend_core.status import Status

    numbers = {**cells, "pending": pending}
    return [
        f"  {s.name.lower():15s} {numbers[s.name.lower()]:>10d}  {s.sentence}"
        for s in Status
        if numbers.get(s.name.lower())
    ]
