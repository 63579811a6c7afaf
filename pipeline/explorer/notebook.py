"""Open a run and show it in a cell of a notebook, whose kernel answers the page."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.explorer.connection import LEAST_HEIGHT
from pipeline.explorer.data.explored import ExploredRun
from pipeline.specification.problems import SpecError, import_extra
from pipeline.store.run import RunDirectory

if TYPE_CHECKING:
    from pipeline.explorer.widget import Explorer


def explorer(
    run: str | Path | RunDirectory, *, curves: str | Path | RunDirectory | None = None, height: int = 720
) -> Explorer:
    """Show a run on the explorer's interactive page, in a cell of Jupyter, VS Code or marimo.

    The kernel answers the page: there is no server, and nothing is read from elsewhere.

    Parameters
    ----------
    run
        Run directory, ``s3://BUCKET/PREFIX``, or an opened run.
    curves
        Run whose bifurcation curves are shown over the map of two parameters; by default those of the run.
    height
        Height of the page [CSS px].

    Returns
    -------
    Explorer
        Widget; as the last value of a cell it is shown. Its ``selected`` is the selected point.

    Raises
    ------
    SpecError
        If anywidget is not installed, or the height is too small.
    RefusedError, DamagedError, UnreadableError
        As `RunDirectory.open`.
    """
    if height < LEAST_HEIGHT:
        raise SpecError(f"height = {height}: must be {LEAST_HEIGHT} pixels or more.")
    import_extra("anywidget", "notebook", "explorer")
    from pipeline.explorer.widget import Explorer

    found = ExploredRun.open(run)
    return Explorer(found if curves is None else replace(found, curves=RunDirectory.open(curves)), height=height)
