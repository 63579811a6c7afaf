"""Draw figures into axes or figures that the caller has made.

All figures are made by `pipeline.plots.style.new_figure`. Inside `drawing_into` it returns a `GuestFigure`, which
passes everything that is drawn on to the caller's axes, figure or subfigure. The functions that draw need no change.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from matplotlib import rcParams
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.gridspec import GridSpec

from pipeline.plots.looks import LOCK, MM
from pipeline.plots.style import STRIP, TARGET, DataFigure, Target

Host = Axes | Figure | SubFigure

MARGIN_MM = 15.0
"""Width beside axes for labels: the caller's axes plus this stand for the width of a figure of one panel."""

_STRIP_PLACE = (0.0, -0.085, 1.0, 0.06)
"""Place of a strip below the caller's axes, in units of the axes."""


class PanelsError(ValueError):
    """An error for a figure of several panels that was to be drawn into one pair of axes."""

    def __init__(self, n: int | str = "several") -> None:
        super().__init__(
            f"the figure has {n} panels, and ax= holds one; give figure= instead: an empty Figure or SubFigure, "
            'such as plt.figure(layout="constrained").'
        )


@contextlib.contextmanager
def drawing_into(host: Host | None, make: Callable[..., Any] | None = None) -> Iterator[None]:
    """Draw the figure that is made inside this context into axes, a figure or a subfigure of the caller.

    Parameters
    ----------
    host
        Axes for a figure of one panel, or an empty figure or subfigure. None for a figure of its own.
    make
        Function that makes a figure of its own, with the keywords ``FigureClass``, ``figsize``, ``facecolor`` and
        ``layout``, ``dpi``, such as `matplotlib.pyplot.figure`. By default the figure is known to its holder alone.

    Raises
    ------
    ValueError
        If a figure or subfigure as `host` has axes or subfigures already.
    """
    if isinstance(host, Figure | SubFigure) and (host.axes or host.subfigs):
        raise ValueError("figure= has axes already; give an empty Figure or SubFigure, or ax= for one of its axes.")

    screen_dpi = rcParams["figure.dpi"]  # before a look changes it

    def guest(**about: Any) -> DataFigure:
        assert host is not None
        return GuestFigure(host, about["figsize"], arranged=about["layout"] is not None)

    def own(**about: Any) -> DataFigure:
        assert make is not None
        figure = make(FigureClass=DataFigure, **{**about, "dpi": about["dpi"] or screen_dpi})
        assert isinstance(figure, DataFigure)
        return figure

    chosen = guest if host is not None else own if make is not None else None
    token = TARGET.set(Target(chosen, host is not None) if chosen is not None else None)
    try:
        yield
    finally:
        TARGET.reset(token)


def width_of(host: Host) -> float:
    """Return the width [mm] for a figure that is drawn into the caller's axes or figure."""
    box, figure = (host.get_window_extent(), host.figure) if isinstance(host, Axes) else (host.bbox, host)
    return float(box.width) / figure.dpi / MM + (MARGIN_MM if isinstance(host, Axes) else 0.0)


class GuestFigure(DataFigure):
    """A figure whose panels, legends and texts lie in axes or a figure of the caller; it is not shown itself.

    Places in the caller's figure count in units of `figsize` [in]. `arranged` says whether the layout of that figure
    finds the places of panels and legends.
    """

    def __init__(self, host: Host, figsize: tuple[float, float], *, arranged: bool = True) -> None:
        self._guests: list[Axes] = []
        self._others: list[Artist] = []
        super().__init__(figsize=figsize)
        self._ax = host if isinstance(host, Axes) else None
        self.settled.update(host.lines if isinstance(host, Axes) else ())
        self._place: Any = host.figure if isinstance(host, Axes) else host
        root = self._place.get_figure(root=True) if isinstance(self._place, SubFigure) else self._place
        self._root: Figure = root
        self._arranged = arranged
        if isinstance(host, Figure) and not arranged:
            host.set_layout_engine("none")  # it would find nothing to arrange, and warn of that
        elif isinstance(host, Figure) and host.get_layout_engine() is None:
            host.set_layout_engine("constrained")  # legends outside of the axes need it

    @property  # type: ignore[misc]
    def axes(self) -> list[Axes]:  # type: ignore[override]
        """Axes of the panels."""
        return self._guests

    def add_subplot(self, *args: Any, **kwargs: Any) -> Any:
        """Return the caller's axes, or axes made in the caller's figure."""
        if self._ax is None:
            return self._panel(self._place.add_subplot(*args, **kwargs))
        if self._guests:
            raise PanelsError
        return self._panel(self._ax)

    def subplots(self, nrows: int = 1, ncols: int = 1, **kwargs: Any) -> Any:
        """Make panels in the caller's figure; raise `PanelsError` for several panels in the caller's axes."""
        if self._ax is not None:
            raise PanelsError(nrows * ncols)
        made = self._place.subplots(nrows, ncols, **kwargs)
        for ax in made.flat if hasattr(made, "flat") else [made]:
            self._panel(ax)
        return made

    def add_axes(self, *args: Any, **kwargs: Any) -> Any:
        """Make axes at a place of the caller's figure."""
        if self._ax is not None:
            raise PanelsError
        return self._panel(self._place.add_axes(*args, **kwargs))

    def add_gridspec(self, nrows: int = 1, ncols: int = 1, **kwargs: Any) -> GridSpec:
        """Return a grid for panels of the caller's figure."""
        grid: GridSpec = self._place.add_gridspec(nrows, ncols, **kwargs)
        return grid

    def add_strip(self, ax: Axes, place: Any) -> Axes:
        """Add a strip below a panel."""
        if self._ax is None:
            return super().add_strip(ax, place)
        strip = self._ax.inset_axes(_STRIP_PLACE, sharex=self._ax, label=STRIP)
        self._others.append(strip)
        return strip

    def colorbar(self, mappable: Any, cax: Any = None, ax: Any = None, use_gridspec: bool = True, **kwargs: Any) -> Any:
        """Add a colour bar beside the panel."""
        bar = self._place.colorbar(mappable, cax=cax, ax=ax, use_gridspec=use_gridspec, **kwargs)
        self._others.append(bar.ax)
        return bar

    def legend(self, *args: Any, **kwargs: Any) -> Any:
        """Add a legend to the caller's figure, or one column inside the caller's axes."""
        if self._ax is not None:
            kwargs = {"handles": kwargs["handles"], "loc": "upper right"}
        made = (self._place if self._ax is None else self._ax).legend(*args, **kwargs)
        self._others.append(made)
        return made

    def text(self, *args: Any, **kwargs: Any) -> Any:
        """Write a text into the caller's figure."""
        return self._passed("text", *args, **kwargs)

    def suptitle(self, *args: Any, **kwargs: Any) -> Any:
        """Write the title of the caller's figure."""
        return self._passed("suptitle", *args, **kwargs)

    def supxlabel(self, *args: Any, **kwargs: Any) -> Any:
        """Write the common label of the horizontal axes."""
        return self._passed("supxlabel", *args, **kwargs)

    def supylabel(self, *args: Any, **kwargs: Any) -> Any:
        """Write the common label of the vertical axes."""
        return self._passed("supylabel", *args, **kwargs)

    def align_ylabels(self, axs: Any = None) -> None:
        """Align the labels of the vertical axes of panels."""
        self._place.align_ylabels(axs)

    def findobj(self, match: Any = None, include_self: bool = True) -> Any:
        """Return what this figure has drawn, and nothing else of the caller's figure."""
        return [found for artist in (*self._guests, *self._others) for found in artist.findobj(match)]

    def arrange(self) -> None:
        """Compute the layout of the caller's figure, which stays free to change."""
        engine = self._root.get_layout_engine()
        if engine is not None and self._arranged:
            with LOCK:
                engine.execute(self._root)

    def _panel(self, ax: Any) -> Any:
        self._guests.append(ax)
        return ax

    def _passed(self, name: str, *args: Any, **kwargs: Any) -> Any:
        made = getattr(self._place, name)(*args, **kwargs)
        self._others.append(made)
        return made
