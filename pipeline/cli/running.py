"""Define ``magpend run``, ``atlas``, ``submit``, ``status`` and ``verify``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.cli import console
from pipeline.cli.common import Csv, Json, check_csv, tell, tell_data
from pipeline.cli.outputs import check_file

if TYPE_CHECKING:
    from pipeline.compute.clients import Where


from collections.abc import Iterable
from typing import TYPE_CHECKING

from pipeline.cli.common import Directory
from pipeline.cli.console import Exit
from pipeline.cli.options import completing
from pipeline.cli.plot import draw

if TYPE_CHECKING:
    from pipeline.store.run import RunDirectory


def workflow_names() -> Iterable[str]:
    """Return the names of the workflows (specifications) that ship with magpend."""
    from pipeline.specification.files import shipped_workflows

    return shipped_workflows()


Spec = Annotated[
    str,
    typer.Argument(
        metavar="SPEC",
        help="A TOML file, or the name of a shipped workflow.",
        autocompletion=completing(workflow_names),
    ),
]


Workers = Annotated[
    int | None, typer.Option(min=0, help="Threads, or processes; 0: the calling thread alone. Default: all cores.")
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="WHERE",
        help="threads; processes; none (the calling thread); a dask scheduler's tcp:// or tls:// address or FILE.json; "
        "or jobs of slurm, pbs, torque, sge, lsf. Default: $DASK_SCHEDULER_ADDRESS, or threads (analyses: processes).",
    ),
]
ClusterFile = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="TOML file whose table [cluster] describes a job. Default: $MAGPEND_CLUSTER."),
]
Dashboard = Annotated[
    bool, typer.Option("--dashboard", help="With a dask scheduler: serve its dashboard, and print the address.")
]
Out = Annotated[str | None, typer.Option(help="Run directory, or s3://BUCKET/PREFIX; by default runs/NAME.")]
Smoke = Annotated[bool, typer.Option("--smoke", help="Run the specification's small size, which takes seconds.")]
Analyses = Annotated[str, typer.Option(metavar="NAMES", help="Analyse the finished run, such as attractors,basins.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Describe the work; create nothing.")]


def run(
    spec: Spec,
    out: Out = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    cluster: ClusterFile = None,
    dashboard: Dashboard = False,
    dry_run: DryRun = False,
    smoke: Smoke = False,
    plot: Annotated[
        bool, typer.Option("--plot", help="Draw the finished run: a diagram, its exponents, or a map.")
    ] = False,
    analyse: Analyses = "",
    posterior: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Run once for each draw of the posterior of an identification.")
    ] = None,
    n_draws: Annotated[int, typer.Option("-n", "--draws", min=1, max=100_000, help="Number of draws.")] = 200,
) -> None:
    """Compute all cells (trajectories) of a specification, or those still missing in its run directory.

    You can stop the command at any time: the same command continues, and the finished files are the same. At
    the end it counts the cells by status. Cells that diverged or failed are results, and the exit code is 0;
    above 1 % a warning reports them.
    """
    from pipeline.compute.clients import Where
    from pipeline.products.plugins import added
    from pipeline.runs import preview
    from pipeline.runs import run as runs
    from pipeline.runs.derive import analyses_in
    from pipeline.runs.status import summary, warning

    analyses = analyses_in(analyse)
    if posterior is not None:
        of_draws = added("functions")["run_posterior"]
        console.result(*of_draws(spec, posterior, n_draws, out, smoke=smoke, workers=workers, echo=console.note))
        return
    if dry_run:
        console.result(*preview.describe_plan(spec, out, workers=workers, smoke=smoke))
        return
    done = runs.run(
        spec,
        out,
        workers=workers,
        scheduler=scheduler,
        cluster=cluster,
        dashboard=dashboard,
        smoke=smoke,
        echo=console.note,
    )
    console.result(f"cube: {done.info.files.below('cube.zarr').name}")
    console.result(*summary(done))
    if text := warning(done):
        console.LOG.warning(text)
    where = Where(scheduler, cluster, dashboard)
    for name in analyses:
        show(done.name, name, {}, workers, where)
    if plot:
        _plot(done)


def _plot(run: RunDirectory) -> None:
    """Draw the figure that shows a finished run best; if it cannot be drawn, print the reason."""
    from pipeline.products.registry import FIGURES
    from pipeline.runs.preview import figure_command, shown
    from pipeline.specification.problems import SpecError
    from pipeline.store.errors import RefusedError

    name, options, left_out = shown(run)
    try:
        draw(run.name, name, FIGURES[name].options(**options))
    except (SpecError, RefusedError) as error:
        console.result(f"no figure: {error}")
        console.result(f"the run is complete; draw it with: {figure_command(run)}")
    else:
        if left_out:
            console.result(left_out)


def atlas(
    source: Annotated[
        str,
        typer.Argument(metavar="SPEC|DIR", help="A TOML file or a shipped workflow over two parameters, or its run."),
    ],
    parameter: Annotated[str, typer.Option(help="First parameter, by default the run's first axis.")] = "",
    second: Annotated[str, typer.Option(help="Second parameter, by default the run's other axis.")] = "",
    budget: Annotated[int, typer.Option(min=0, help="Most cells at further points, where the audit is worst.")] = 0,
    windows: Annotated[
        int | None, typer.Option(min=0, help="Places at which ends of chaotic sets and tori are named.")
    ] = None,
    out: Annotated[str | None, typer.Option(help="Run directory of a specification; by default runs/NAME.")] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    cluster: ClusterFile = None,
    smoke: Smoke = False,
    csv: Csv = None,
    json: Json = None,
) -> None:
    """Chart a plane of two parameters: run it if need be, find its regions and curves, audit them, and draw the chart.

    It is what magpend run, analyse atlas and plot atlas do one after the other; these have further options. You can
    stop it at any time: the same command continues.
    """
    from pipeline.compute.clients import Where
    from pipeline.products.registry import FIGURES
    from pipeline.runs import run as runs
    from pipeline.store.objects import open_files
    from pipeline.store.runfile import is_run

    check_csv(csv)
    where, directory = Where(scheduler, cluster), source
    if not is_run(open_files(source)):
        done = runs.run(
            source, out, workers=workers, scheduler=scheduler, cluster=cluster, smoke=smoke, echo=console.note
        )
        directory = done.name
    chosen: dict[str, Any] = {"parameter": parameter, "second": second, "budget": budget}
    chosen |= {} if windows is None else {"windows": windows}
    show(directory, "atlas", chosen, workers, where, csv, json)
    draw(directory, "atlas", FIGURES["atlas"].options(**chosen))


def status(directory: Directory, json: Json = None) -> None:
    """Print how much of a run is computed and stored, and how many cells have each status."""
    from pipeline.products.product import Table
    from pipeline.runs.status import describe_state, state

    found = state(directory)
    row = {
        "directory": found.name,
        "title": found.spec.title,
        "complete": found.complete,
        "cells": found.plan.n_cells,
        "committed_cells": found.n_committed,
        "tasks": found.plan.n_tasks,
        "committed_tasks": len(found.commits),
        "method": found.spec.integration.method,
        "status": dict(found.cells),
    }
    tell(Table([row], describe_state(found)), None, json)


def verify(
    directory: Directory,
    repair: Annotated[
        bool,
        typer.Option(
            "--repair",
            help="Rebuild damaged metadata and coordinates; withdraw damaged tasks, which the next run computes again.",
        ),
    ] = False,
) -> None:
    """Check a run for damage: stored bytes against the commit records, metadata and coordinates against run.json."""
    from pipeline.runs import verify as verification

    found = verification.verify_run(directory, repair=repair)
    console.result(*verification.describe(found, directory, repaired=repair))
    if not (found.sound or (repair and not found.skeleton)):
        raise typer.Exit(Exit.DAMAGED)


def show(
    directory: str,
    name: str,
    options: Any,
    workers: int | None,
    where: Where,
    csv: str | None = None,
    json: str | None = None,
    out: Path | None = None,
) -> None:
    """Compute an analysis, or read it if it is stored, print its table, and write it to the file `out`."""
    from pipeline.runs.derive import derive, shown_table
    from pipeline.specification.problems import SpecError

    ds = derive(directory, name, options, echo=console.note, workers=workers, scheduler=where)
    table = shown_table(name, ds)
    if table.nothing:
        raise SpecError(f"{directory}: {table.nothing}")
    tell(table, csv, json)
    if out is not None:
        from pipeline.runs.exporting import save

        console.note(f"result: {save(ds, out)}")
    if "source" in ds.encoding:
        console.note(f"stored: {ds.encoding['source']}")


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
