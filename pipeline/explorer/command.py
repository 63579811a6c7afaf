"""Define ``magpend explore`` and ``export``: the interactive page of a run in a browser, and as files."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated

import typer

from pipeline.cli import console
from pipeline.cli.common import Directory
from pipeline.cli.options import FORCE
from pipeline.cli.outputs import check_page


def explore(
    directory: Directory,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port on this machine; 0 selects a free one.")] = 0,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Print the address of the page; open no browser.")
    ] = False,
    curves: Annotated[
        str, typer.Option(help="Run whose bifurcation curves are drawn over the map of this run's two parameters.")
    ] = "",
) -> None:
    """Explore a run in a browser: its diagram, the orbit behind each point, planes of initial states.

    The page is served only to this machine, at an address with a token, until you press Ctrl-C. It reads the
    run and changes nothing. It shows the results of analyses that you have run. From another machine, tunnel
    the port: ssh -L PORT:127.0.0.1:PORT
    """
    from pipeline.explorer.server import browser, serve

    def serving(address: str) -> None:
        console.at_rest()
        console.result(address)
        console.note("open this address in a browser on this machine; Ctrl-C ends the server")

    with contextlib.nullcontext() if no_browser else browser() as opened:
        serve(directory, port, echo=serving, opened=opened, curves=curves or None)


def export(
    directory: Directory,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "--page", metavar="FILE.html", help="One file that opens by a double click. Default: NAME.html."
        ),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(
            metavar="OUT", help="Folder for a static web host instead, with the whole cube, loaded on demand."
        ),
    ] = None,
    force: FORCE = False,
    quantity: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Additional quantity of the model for the vertical axis.")
    ] = None,
    orbits: Annotated[int, typer.Option(min=0, help="Largest number of orbits to integrate and include.")] = 2000,
    megabytes: Annotated[float, typer.Option(min=1, max=100, help="Largest size of the single file [MB].")] = 20.0,
) -> None:
    """Write the interactive page of a run as files that need no magpend server, to send or publish.

    The files hold the diagram, its overlays and the orbits of attractors, but no live integration. Parts that
    do not fit into one file are left out, and the page names them.
    """
    from pipeline.explorer.copies.export import export_folder, export_page
    from pipeline.specification.problems import SpecError
    from pipeline.store.run import RunDirectory

    if out is not None and folder is not None:
        raise SpecError("--out and --folder: give one of them.")
    run, wanted = RunDirectory.open(directory), quantity or []
    page = out or Path(f"{Path(run.name).resolve().name}.html")
    if folder is None:
        check_page(page, [run.info.digest], f" For a folder of files give --folder {page}.")
    with console.progress("exporting"):
        if folder is not None:
            written = export_folder(run, folder, force=force, quantities=wanted, most_orbits=orbits)
        else:
            written = export_page(
                run, page, force=True, quantities=wanted, most_orbits=orbits, most_bytes=round(megabytes * 1e6)
            )
    for sentence in written.sentences:
        console.note(f"note: {sentence}")
    where = written.path / "index.html" if folder is not None else written.path
    console.result(f"page: {where} ({written.size / 1e6:.1f} MB, {written.orbits:,} orbits)")
