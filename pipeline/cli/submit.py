"""Define ``magpend submit``, which runs a specification as a batch job."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeline.cli import console
from pipeline.cli.running import ClusterFile, Spec


def submit(
    spec: Spec,
    out: Annotated[Path | None, typer.Option(help="Run directory; by default runs/NAME.")] = None,
    cluster: ClusterFile = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the batch script; create and send nothing.")
    ] = False,
    smoke: Annotated[
        bool, typer.Option("--smoke", help="Run the specification's small size, which takes seconds.")
    ] = False,
) -> None:
    """Submit a specification as a job of SLURM, PBS, Grid Engine or LSF, and print commands to watch and cancel the
    job.

    The job continues where an earlier one was stopped.
    """
    from pipeline.runs.submit import prepare, send

    prepared = prepare(spec, out, cluster, smoke=smoke)
    if dry_run:
        console.result(prepared.script.rstrip("\n"))
    elif prepared.complete:
        console.result(f"{prepared.name} is complete; nothing to send.")
    else:
        console.result(*send(prepared).lines())
