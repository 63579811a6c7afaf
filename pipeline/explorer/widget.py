"""Make the widget that shows a run in Jupyter, VS Code and marimo."""

from __future__ import annotations

import atexit
import contextlib
import json
import re
import weakref
from collections.abc import Mapping
from importlib import resources
from typing import TYPE_CHECKING, Any

import anywidget
import traitlets

from pipeline.explorer import RequestError
from pipeline.explorer.answers import Answering
from pipeline.explorer.connection import LEAST_HEIGHT, Connection, GoneError
from pipeline.explorer.data.orbits import facts
from pipeline.explorer.data.tables import orbit_dataset
from pipeline.store.run import RunDirectory

if TYPE_CHECKING:
    import xarray as xr


_POINT = re.compile(r"(?:^|&)point=(\d{1,15}),(\d{1,15})(?=&|$)")

_OPEN: weakref.WeakSet[Explorer] = weakref.WeakSet()


class Explorer(anywidget.AnyWidget):
    """Interactive page of a run in a notebook: bifurcation diagram, orbits, slices of basins, live computation.

    Attributes
    ----------
    selected : dict or None
        The selected section point: ``cell``, ``point``, ``state``, ``parameters``, ``frequency`` [Hz], ``start``
        (the cell's initial state), ``status``, ``period`` and, where analyses of the run have them, its attractor
        with kind, stability, share of the starts, multipliers and exponents. Set it to ``{"cell": 12}`` or
        ``{"cell": 12, "point": 3}`` to select a point, and to None to deselect.
    view : str
        What the page shows, as in the address of ``magpend explore`` after ``#``: axes, window, colours,
        selected point. It can be set as well.
    height : int
        Height of the page [CSS px].
    """

    _esm = (resources.files("pipeline.explorer") / "static" / "explorer-widget.js").read_text("utf-8")

    selected = traitlets.Dict(default_value=None, allow_none=True).tag(sync=True)
    view = traitlets.Unicode("").tag(sync=True)
    height = traitlets.Int(720, min=LEAST_HEIGHT).tag(sync=True)

    def __init__(self, run: RunDirectory, *, height: int = 720) -> None:
        self._answering = Answering(run)
        self._connection = Connection(self._answering, self._deliver)
        super().__init__(height=height)
        self.on_msg(lambda widget, content, buffers: self._connection.receive(content))
        _OPEN.add(self)

    def _deliver(self, content: dict[str, Any], buffers: list[bytes]) -> None:
        """Send a message to the pages; marimo closes the comm of a cell that runs again, and tells nobody."""
        if getattr(self.comm, "_closed", False):
            raise GoneError
        self.send(content, buffers)

    # ---- what is selected --------------------------------------------------------------------

    @traitlets.validate("selected")
    def _complete(self, proposal: Mapping[str, Any]) -> dict[str, Any] | None:
        """Complete a selection: a cell, or a cell and a section point, becomes all that is known of it."""
        given = proposal["value"]
        if given is None:
            return None
        cell, point = given.get("cell"), given.get("point")
        if type(cell) is not int or (point is not None and type(point) is not int):
            example = '{"cell": 12} or {"cell": 12, "point": 3}'
            raise traitlets.TraitError(f"selected = {json.dumps(given, default=str)[:200]}: give it as {example}.")
        try:
            # as JSON has it, so that Python and the page have equal values
            return dict(json.loads(json.dumps(facts(self._answering.run, cell, point))))
        except RequestError as error:
            raise traitlets.TraitError(f"selected: {error}") from None

    @traitlets.observe("selected")
    def _show_selected(self, change: Mapping[str, Any]) -> None:
        chosen = change["new"]
        if _point_of(self.view) == (chosen and (chosen["cell"], chosen["point"])):
            return
        parts = [part for part in self.view.split("&") if part and not part.startswith("point=")]
        if chosen is not None:
            parts.append(f"point={chosen['cell']},{chosen['point']}")
        self.view = "&".join(parts)

    @traitlets.observe("view")
    def _take_selected(self, change: Mapping[str, Any]) -> None:
        chosen, found = self.selected, _point_of(change["new"])
        if found == (chosen and (chosen["cell"], chosen["point"])):
            return
        try:
            self.set_trait("selected", None if found is None else {"cell": found[0], "point": found[1]})
        except traitlets.TraitError:  # an address can name what the run does not have
            self.set_trait("selected", None)

    def orbit(self) -> xr.Dataset | None:
        """Integrate the selected orbit again; return its states and quantities over time.

        Returns
        -------
        Dataset or None
            A row per instant, over the orbit's period or some periods of a motion that does not close; None if
            nothing is selected.
        """
        chosen: Any = self.selected
        return None if chosen is None else orbit_dataset(self._answering.run, chosen["cell"], chosen["point"])

    # ---- its end -----------------------------------------------------------------------------

    def end(self) -> None:
        """End all computations of the widget; its page shows what it has, and answers no more."""
        self._connection.close()
        self._answering.close()

    def close(self) -> None:
        """End all computations and remove the widget from the notebook."""
        self.end()
        super().close()


def _point_of(view: str) -> tuple[int, int] | None:
    """Return the cell and the section that an address names."""
    found = _POINT.search(view)
    return None if found is None else (int(found[1]), int(found[2]))


@atexit.register
def _end_all() -> None:
    """End the computations of all widgets with the kernel, also those in processes of their own."""
    for widget in list(_OPEN):
        with contextlib.suppress(Exception):
            widget.end()
