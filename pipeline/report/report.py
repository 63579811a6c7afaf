"""One page on one or several runs: ``magpend report``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import metadata

from pipeline.report.page import Grid, Page
from pipeline.report.runs import CHEAP, SHOWN, part_of
from pipeline.runs.derive import AnalysedRun
from pipeline.spec.problems import SpecError, unknown_name

Echo = Callable[[str], None]


def report(
    directories: Sequence[str],
    *,
    title: str = "",
    also: Sequence[str] = (),
    only_stored: bool = False,
    echo: Echo = print,
) -> Page:
    """Return the page on some runs.

    Parameters
    ----------
    directories
        Run directories; each is opened before anything is computed.
    title
        Of the page; by default that of the run, or how many there are.
    also
        Analyses that are computed besides those of `pipeline.report.runs.CHEAP`, as ``magpend analyse`` does.
    only_stored
        Compute nothing: draw and list what stands in the cubes and in ``derived/``.
    echo
        Prints a line.

    Raises
    ------
    SpecError
        If an analysis is unknown.
    RefusedError, DamagedError, UnreadableError
        As `pipeline.store.run.Run.open`.
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
    """Program and version."""
    return f"magpend {metadata.version('magpend')}"


def _summary(runs: Sequence[AnalysedRun]) -> Grid:
    """What is on the page, if there are several runs."""
    rows = [
        (
            run.info.title or run.name,
            run.name,
            run.model.name,
            run.spec.kind,
            str(run.plan.n_cells),
            run.digest[:12],
        )
        for run in runs
    ]
    return Grid(("run", "directory", "model", "kind", "cells", "digest of the cube"), rows)
