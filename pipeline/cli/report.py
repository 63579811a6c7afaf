"""Define ``magpend report``, which writes one HTML page about runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeline.cli import console
from pipeline.cli.outputs import check_page


def report(
    directories: Annotated[list[str], typer.Argument(metavar="DIR...", help="Run directories, or s3://BUCKET/PREFIX.")],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="File of the page. Default: NAME-report.html, by the first run.")
    ] = None,
    title: Annotated[str, typer.Option(help="Title of the page; by default that of the run.")] = "",
    also: Annotated[
        list[str] | None,
        typer.Option(
            "--with", metavar="ANALYSIS", help="Additional analysis to compute: branches, chaos, ...; may be repeated."
        ),
    ] = None,
    only_stored: Annotated[
        bool, typer.Option("--only-stored", help="Compute nothing; show only stored results.")
    ] = False,
) -> None:
    """Write one HTML page on runs: parameters, diagram, attractors, bifurcations, exponents, provenance.

    The page is self-contained: it needs no script and no network. You can print it. Attractors, basins and
    the hysteresis of a continuation are computed if they are missing. For other missing results the page
    names the command.
    """
    from pipeline.report.page import write
    from pipeline.report.report import report as make
    from pipeline.store.runfile import read_run

    infos = [read_run(directory) for directory in directories]
    if out is None:
        out = Path(f"{Path(infos[0].name).resolve().name}-report.html")
    check_page(out, [info.digest for info in infos])
    page = make(directories, title=title, also=also or [], only_stored=only_stored, echo=console.note)
    write(page, out)
    console.result(f"report: {out} ({out.stat().st_size / 1e6:.1f} MB)")
