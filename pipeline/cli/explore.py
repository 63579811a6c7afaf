"""Define ``magpend explore DIR``, which shows a run on an interactive page in a browser."""

from __future__ import annotations

import contextlib
from typing import Annotated

import typer

from pipeline.cli import console
from pipeline.cli.common import Directory


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
