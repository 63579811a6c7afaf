"""Define ``magpend reproduce``, which computes the figures of a study and tests its claims."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

from pipeline.cli import console
from pipeline.cli.console import Exit
from pipeline.cli.options import completing
from pipeline.cli.outputs import check_place


def studies() -> Iterable[str]:
    """Return the names of the studies that ship with magpend."""
    from pipeline.report.study import shipped_studies

    return shipped_studies()


def reproduce(
    study: Annotated[
        str,
        typer.Argument(
            metavar="STUDY", help="Name of a study that ships, or its TOML file.", autocompletion=completing(studies)
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of all results; by default reproduce/STUDY.")
    ] = None,
    figure: Annotated[
        list[str] | None,
        typer.Option(metavar="N", help="Number of a figure to reproduce; may be repeated. Default: all."),
    ] = None,
    smoke: Annotated[
        bool, typer.Option("--smoke", help="Use the small size: it takes minutes and leaves most claims undecided.")
    ] = False,
    workers: Annotated[
        int | None, typer.Option(help="Threads, 0: none. By default one per core; with --smoke none.", min=0)
    ] = None,
) -> None:
    """Compute and draw the figures of a study, test its claims, and write one HTML page on them.

    Complete runs are used, other runs are continued. Every claim gets a measured value with its interval, and
    one of four verdicts. A coarse grid or a small sample leaves a claim undecided.
    """
    from pipeline.report.reproduce import calibrated_on, decided_first, headline, spelled
    from pipeline.report.reproduce import reproduce as carry_out
    from pipeline.report.study import load_study

    found = load_study(study)
    folder = out or Path("reproduce") / (found.name + ("-smoke" if smoke else ""))
    _check_folder(folder)
    n_workers = 0 if smoke and workers is None else workers
    done = carry_out(found, folder, figures=figure or [], smoke=smoke, workers=n_workers, echo=console.note)
    if done.judgements:
        console.result(headline(done.judgements, smoke))
    for j in decided_first(done.judgements):
        console.result(f"{j.figure:>8}  {j.verdict.words}: {j.claim.statement} {spelled(j)} {j.reason}".rstrip())
    if calibrated := calibrated_on(done.judgements):
        console.result(calibrated)
    console.result(f"report: {done.page} ({done.page.stat().st_size / 1e6:.1f} MB)")
    if done.failed:
        console.LOG.error(
            f"{len(done.failed)} required claims are contradicted: "
            + "; ".join(f"figure {j.figure}: {j.claim.statement}" for j in done.failed)
        )
        raise typer.Exit(int(Exit.CONTRADICTED))


def _check_folder(folder: Path) -> None:
    from pipeline.specification.problems import SpecError
    from pipeline.store.errors import RefusedError
    from pipeline.store.local import unwritable

    if folder.exists() and not folder.is_dir():
        raise SpecError(f"--out {folder}: is a file; give a folder.")
    check_place(folder)
    there = next(place for place in (folder, *folder.absolute().parents) if place.is_dir())
    if problem := unwritable(there):
        raise RefusedError(f"{problem}; give another place: --out DIR.")
