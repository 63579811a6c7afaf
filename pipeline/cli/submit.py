"""Define ``magpend submit``, which runs a specification as a batch job."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeline.cli.common import Json, tell_data
from pipeline.cli.outputs import check_file
from pipeline.cli.running import Analyses, Out, Smoke, Spec


def submit(
    spec: Spec,
    out: Out = None,
    cluster: Annotated[
        str | None,
        typer.Option(
            metavar="WHICH",
            help="slurm, pbs, torque, sge or lsf, or a TOML file whose table [cluster] describes a job. Default: "
            "$MAGPEND_CLUSTER, or the batch system whose commands are here.",
        ),
    ] = None,
    job: Annotated[
        list[str] | None,
        typer.Option(
            "--job", metavar="KEY=VALUE", help="Change a key of [cluster], such as walltime=02:00:00; several times."
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Explain the jobs and print their files; create and send nothing.")
    ] = False,
    write: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the job file to FILE, and send nothing.")
    ] = None,
    smoke: Smoke = False,
    analyse: Analyses = "",
    json: Json = None,
) -> None:
    """Submit a specification as a job of SLURM, PBS, Torque, Grid Engine or LSF, and print commands to watch and cancel
    the job.

    What is not given is chosen: the batch system whose commands are here, its default queue, and cores, memory
    and time by the measured work. The job continues where an earlier one was stopped.
    """
    from pipeline.runs import submit as sending
    from pipeline.specification.problems import SpecError

    if dry_run and write is not None:
        raise SpecError("--dry-run and --write FILE: give one of them; --dry-run creates nothing.")
    if write is not None:
        check_file(write, "--write")
    prepared = sending.prepare(spec, out, cluster, job or [], smoke=smoke, analyse=analyse)
    if dry_run:
        tell_data(sending.as_data(prepared), sending.explain(prepared), json)
    elif prepared.complete:
        tell_data(sending.as_data(prepared), [f"{prepared.name} is complete; nothing to send."], json)
    elif write is not None:
        sending.write(prepared, write)
        tell_data(sending.as_data(prepared), sending.written(prepared, str(write)), json)
    else:
        sent = sending.send(prepared)
        tell_data(sending.as_data(sent), sending.brief(sent), json)
