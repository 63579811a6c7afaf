"""Define ``magpend atlas``, which runs a specification if need be, charts its plane, and draws it."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from pipeline.cli import console
from pipeline.cli.common import Csv, Json, check_csv
from pipeline.cli.plot import draw
from pipeline.cli.running import ClusterFile, Scheduler, Smoke, Workers, show


def atlas(
    source: Annotated[
        str,
        typer.Argument(metavar="SPEC|DIR", help="A TOML file or a shipped workflow over two parameters, or its run."),
    ],
    parameter: Annotated[str, typer.Option(help="First parameter, by default the run's first axis.")] = "",
    second: Annotated[str, typer.Option(help="Second parameter, by default the run's other axis.")] = "",
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
    chosen: dict[str, Any] = {"parameter": parameter, "second": second}
    show(directory, "atlas", chosen, workers, where, csv, json)
    draw(directory, "atlas", FIGURES["atlas"].options(**chosen))
