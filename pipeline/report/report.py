"""Make the report page about one or several runs, for ``magpend report``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import metadata

from pipeline.report.page import Grid, Page
from pipeline.report.runs import CHEAP, SHOWN, part_of
from pipeline.runs.derive import AnalysedRun
from pipeline.specification.problems import SpecError, unknown_name

Echo = Callable[[str], None]


def report(
    directories: Sequence[str],
    *,
    title: str = "",
    also: Sequence[str] = (),
    only_stored: bool = False,
    echo: Echo = print,
) -> Page:
    """Make the report page about one or several runs.

    Parameters
    ----------
    directories
        Run directories; each is opened before anything is computed.
    title
        Title of the page; by default the run's, or the number of runs.
    also
        Analyses that are computed in addition to `pipeline.report.runs.CHEAP`, as ``magpend analyse`` does.
    only_stored
        Whether to compute nothing, and to show only the cubes and the results in ``derived/``.
    echo
        Function that prints a line.

    Raises
    ------
    SpecError
        If an analysis is unknown.
    RefusedError, DamagedError, UnreadableError
        See `pipeline.store.run.RunDirectory.open`.
    """
    unknown = [unknown_name("analysis", name, SHOWN) for name in also if name not in SHOWN]
    if unknown:
        raise SpecError(unknown)
    computed = () if only_stored else (*CHEAP, *also)
    runs = [AnalysedRun.of(directory, echo) for directory in directories]
    parts = [part_of(run, echo, computed) for run in runs]
    if len(parts) == 1:  # its title is the page's
        return Page(title or parts[0].title, parts[0].blocks, parts[0].parts, made_by())
    return Page(title or f"{len(parts)} runs", [_summary(runs)], parts, made_by())


def made_by() -> str:
    """Return the name and the version of this program."""
    return f"magpend {metadata.version('magpend')}"


def _summary(runs: Sequence[AnalysedRun]) -> Grid:
    rows = [
        (run.info.title or run.name, run.name, run.model.name, run.spec.kind, str(run.plan.n_cells), run.digest[:12])
        for run in runs
    ]
    return Grid(("run", "directory", "model", "kind", "cells", "digest of the cube"), rows)
