"""``magpend explore DIR``: a page on which one sees a run."""

from __future__ import annotations

import contextlib
from typing import Annotated

import typer

from pipeline.cli.common import Directory


def explore(
    directory: Directory,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port on this machine; 0 takes a free one.")
    ] = 0,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Say where the page is; open none.")
    ] = False,
) -> None:
    """Look at a run in a browser: its diagram, the orbit behind each point, planes of initial states.

    The page is served to this machine alone, at an address with a token, until Ctrl-C. It reads what is in
    the run and changes nothing; what analyses found is shown once they have been made. On another machine,
    tunnel the port: ssh -L PORT:127.0.0.1:PORT
    """
    from pipeline.cli import console
    from pipeline.explorer.browser import browser
    from pipeline.explorer.server import serve

    def serving(address: str) -> None:
        console.at_rest()
        console.result(address)
        console.note("the page is at this address, for this machine alone; Ctrl-C ends it")

    with contextlib.nullcontext() if no_browser else browser() as opened:
        serve(directory, port, echo=serving, opened=opened)
