"""Define a method for every figure of a run.

Generated from the options of `pipeline.products` by ``python -m pipeline.cli.reference``; do not edit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Literal, overload

from magpend._bases import Drawing, Panels

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


class Plots(Drawing):
    """The figures of a run or a cube, by name; each method draws one and returns its axes."""

    @overload
    def bifurcation(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        state: str = "",
        quantity: str = "",
        layout: Literal["overlay"] = "overlay",
        posterior: str = "",
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Axes: ...

    @overload
    def bifurcation(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        state: str = "",
        quantity: str = "",
        layout: Literal["side"],
        posterior: str = "",
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Panels: ...

    def bifurcation(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        state: str = "",
        quantity: str = "",
        layout: Literal["overlay", "side"] = "overlay",
        posterior: str = "",
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Any:
        """Draw a bifurcation diagram: section points over the swept parameter, coloured by class of motion.

        Parameters
        ----------
        at
            Value of an axis that the figure does not show.
        nearest
            Use the axes' values nearest to `at`, and print them; otherwise `at` must match.
        degrees
            Use degrees instead of radians.
        width
            Width of the figure; 85 is a journal's column [mm] (40 or more, at most 1000).
        xlim
            Range of the horizontal axis, in its unit.
        ylim
            Range of the vertical axis, in its unit.
        style
            Style of matplotlib that changes magpend's: its name, or a style file.
        dpi
            Resolution; by default 200, or that of the style [1/in] (20 or more, at most 2400).
        state
            State to draw; by default the model's first.
        quantity
            Quantity over each kept period instead of a state: NAME.min, NAME.max or NAME.mean; the run needs the
            product extremes.
        layout
            Both directions in one panel, or one panel each.
        posterior
            Directory of magpend identify posterior whose 95 % bands are drawn.
        ax
            Axes to draw into; for a figure of one panel.
        figure
            Empty figure or subfigure to draw into. By default pyplot makes a figure.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Any
            The axes drawn into. With ``layout='side'``: array of the panels' axes, without colour bars.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._either("bifurcation", locals())

    def section(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        state: str = "",
        tolerance: float = 0.0,
        polish: bool = True,
        residual: float = 1e-10,
        max_orbit_period: int = 32,
        n_points: int = 64,
        mirror_threshold: float = 0.3,
        extend: bool = True,
        budget: float = 1.0,
        n_sample: int = 24,
        lifetime_confidence: float = 0.95,
        threshold: float = 0.3,
        look_back: int = 3,
        connect: bool = True,
        against: str = "",
        colour: Literal["motion", "attractor"] = "motion",
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Axes:
        """Draw the section of one parameter point in the plane of two states.

        Choose a part with `xlim` and `ylim`. Many points are drawn as counts per pixel.

        Parameters
        ----------
        at
            Value of an axis that the figure does not show.
        nearest
            Use the axes' values nearest to `at`, and print them; otherwise `at` must match.
        degrees
            Use degrees instead of radians.
        width
            Width of the figure; 85 is a journal's column [mm] (40 or more, at most 1000).
        xlim
            Range of the horizontal axis, in its unit.
        ylim
            Range of the vertical axis, in its unit.
        style
            Style of matplotlib that changes magpend's: its name, or a style file.
        dpi
            Resolution; by default 200, or that of the style [1/in] (20 or more, at most 2400).
        state
            State to draw; by default the model's first.
        tolerance
            Largest distance of a closed cell from its orbit, in units of the states' scales; 0 stands for ten times the
            run's closure tolerance, at least 1e-4 (0 or more).
        polish
            Refine orbits by Newton's method, which integrates a point per orbit.
        residual
            Scaled residual at which Newton's method has converged (above 0).
        max_orbit_period
            Longest orbit period that is sought in cells that are not closed [drive periods or returns] (1 or more).
        n_points
            Section points stored per attractor (1 or more).
        mirror_threshold
            Largest distance of a mirror partner from the image (above 0).
        extend
            Extend the integration of sample cells that are on no known orbit, to find their sets.
        budget
            Longest extension at a parameter point, in units of the run's own integration there (0 or more).
        n_sample
            Number of cells in the first sample that is extended (1 or more).
        lifetime_confidence
            Level of the intervals of lifetimes (above 0, below 1).
        threshold
            Matching: largest distance between sets with one id (above 0).
        look_back
            Matching: steps over which an id is remembered (1 or more).
        connect
            Matching: follow closed orbits along the axes by integration; otherwise match by distance.
        against
            State on the vertical axis; by default the other state's rate, or the next state.
        colour
            Colour by class of motion, or by attractor; attractors are computed first.
        ax
            Axes to draw into; for a figure of one panel.
        figure
            Empty figure or subfigure to draw into. By default pyplot makes a figure.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Axes
            The axes drawn into.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._one("section", locals())

    def attractors(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        state: str = "",
        tolerance: float = 0.0,
        polish: bool = True,
        residual: float = 1e-10,
        max_orbit_period: int = 32,
        n_points: int = 64,
        mirror_threshold: float = 0.3,
        extend: bool = True,
        budget: float = 1.0,
        n_sample: int = 24,
        lifetime_confidence: float = 0.95,
        threshold: float = 0.3,
        look_back: int = 3,
        connect: bool = True,
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Axes:
        """Draw all coexisting attractors over the swept parameter, with the hysteresis of a continuation.

        Parameters
        ----------
        at
            Value of an axis that the figure does not show.
        nearest
            Use the axes' values nearest to `at`, and print them; otherwise `at` must match.
        degrees
            Use degrees instead of radians.
        width
            Width of the figure; 85 is a journal's column [mm] (40 or more, at most 1000).
        xlim
            Range of the horizontal axis, in its unit.
        ylim
            Range of the vertical axis, in its unit.
        style
            Style of matplotlib that changes magpend's: its name, or a style file.
        dpi
            Resolution; by default 200, or that of the style [1/in] (20 or more, at most 2400).
        state
            State to draw; by default the model's first.
        tolerance
            Largest distance of a closed cell from its orbit, in units of the states' scales; 0 stands for ten times the
            run's closure tolerance, at least 1e-4 (0 or more).
        polish
            Refine orbits by Newton's method, which integrates a point per orbit.
        residual
            Scaled residual at which Newton's method has converged (above 0).
        max_orbit_period
            Longest orbit period that is sought in cells that are not closed [drive periods or returns] (1 or more).
        n_points
            Section points stored per attractor (1 or more).
        mirror_threshold
            Largest distance of a mirror partner from the image (above 0).
        extend
            Extend the integration of sample cells that are on no known orbit, to find their sets.
        budget
            Longest extension at a parameter point, in units of the run's own integration there (0 or more).
        n_sample
            Number of cells in the first sample that is extended (1 or more).
        lifetime_confidence
            Level of the intervals of lifetimes (above 0, below 1).
        threshold
            Matching: largest distance between sets with one id (above 0).
        look_back
            Matching: steps over which an id is remembered (1 or more).
        connect
            Matching: follow closed orbits along the axes by integration; otherwise match by distance.
        ax
            Axes to draw into; for a figure of one panel.
        figure
            Empty figure or subfigure to draw into. By default pyplot makes a figure.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Axes
            The axes drawn into.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._one("attractors", locals())

    def gallery(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        tolerance: float = 0.0,
        polish: bool = True,
        residual: float = 1e-10,
        max_orbit_period: int = 32,
        n_points: int = 64,
        mirror_threshold: float = 0.3,
        extend: bool = True,
        budget: float = 1.0,
        n_sample: int = 24,
        lifetime_confidence: float = 0.95,
        threshold: float = 0.3,
        look_back: int = 3,
        connect: bool = True,
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Panels:
        """Draw the attractors of one parameter point: phase portraits, and the model's own drawing of the path.

        One period of each attractor is integrated for the portraits.

        Parameters
        ----------
        at
            Value of an axis that the figure does not show.
        nearest
            Use the axes' values nearest to `at`, and print them; otherwise `at` must match.
        degrees
            Use degrees instead of radians.
        width
            Width of the figure; 85 is a journal's column [mm] (40 or more, at most 1000).
        xlim
            Range of the horizontal axis, in its unit.
        ylim
            Range of the vertical axis, in its unit.
        style
            Style of matplotlib that changes magpend's: its name, or a style file.
        dpi
            Resolution; by default 200, or that of the style [1/in] (20 or more, at most 2400).
        tolerance
            Largest distance of a closed cell from its orbit, in units of the states' scales; 0 stands for ten times the
            run's closure tolerance, at least 1e-4 (0 or more).
        polish
            Refine orbits by Newton's method, which integrates a point per orbit.
        residual
            Scaled residual at which Newton's method has converged (above 0).
        max_orbit_period
            Longest orbit period that is sought in cells that are not closed [drive periods or returns] (1 or more).
        n_points
            Section points stored per attractor (1 or more).
        mirror_threshold
            Largest distance of a mirror partner from the image (above 0).
        extend
            Extend the integration of sample cells that are on no known orbit, to find their sets.
        budget
            Longest extension at a parameter point, in units of the run's own integration there (0 or more).
        n_sample
            Number of cells in the first sample that is extended (1 or more).
        lifetime_confidence
            Level of the intervals of lifetimes (above 0, below 1).
        threshold
            Matching: largest distance between sets with one id (above 0).
        look_back
            Matching: steps over which an id is remembered (1 or more).
        connect
            Matching: follow closed orbits along the axes by integration; otherwise match by distance.
        ax
            Axes to draw into; for a figure of one panel.
        figure
            Empty figure or subfigure to draw into. By default pyplot makes a figure.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Panels
            Array of the panels' axes, without colour bars.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._several("gallery", locals())

    def basins(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        tolerance: float = 0.0,
        polish: bool = True,
        residual: float = 1e-10,
        max_orbit_period: int = 32,
        n_points: int = 64,
        mirror_threshold: float = 0.3,
        extend: bool = True,
        budget: float = 1.0,
        n_sample: int = 24,
        lifetime_confidence: float = 0.95,
        threshold: float = 0.3,
        look_back: int = 3,
        connect: bool = True,
        shade: bool = False,
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Axes:
        """Draw basins of attraction: the attractor on which each initial state of a grid ends.

        Parameters
        ----------
        at
            Value of an axis that the figure does not show.
        nearest
            Use the axes' values nearest to `at`, and print them; otherwise `at` must match.
        degrees
            Use degrees instead of radians.
        width
            Width of the figure; 85 is a journal's column [mm] (40 or more, at most 1000).
        xlim
            Range of the horizontal axis, in its unit.
        ylim
            Range of the vertical axis, in its unit.
        style
            Style of matplotlib that changes magpend's: its name, or a style file.
        dpi
            Resolution; by default 200, or that of the style [1/in] (20 or more, at most 2400).
        tolerance
            Largest distance of a closed cell from its orbit, in units of the states' scales; 0 stands for ten times the
            run's closure tolerance, at least 1e-4 (0 or more).
        polish
            Refine orbits by Newton's method, which integrates a point per orbit.
        residual
            Scaled residual at which Newton's method has converged (above 0).
        max_orbit_period
            Longest orbit period that is sought in cells that are not closed [drive periods or returns] (1 or more).
        n_points
            Section points stored per attractor (1 or more).
        mirror_threshold
            Largest distance of a mirror partner from the image (above 0).
        extend
            Extend the integration of sample cells that are on no known orbit, to find their sets.
        budget
            Longest extension at a parameter point, in units of the run's own integration there (0 or more).
        n_sample
            Number of cells in the first sample that is extended (1 or more).
        lifetime_confidence
            Level of the intervals of lifetimes (above 0, below 1).
        threshold
            Matching: largest distance between sets with one id (above 0).
        look_back
            Matching: steps over which an id is remembered (1 or more).
        connect
            Matching: follow closed orbits along the axes by integration; otherwise match by distance.
        shade
            Darken cells that took longer to converge.
        ax
            Axes to draw into; for a figure of one panel.
        figure
            Empty figure or subfigure to draw into. By default pyplot makes a figure.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Axes
            The axes drawn into.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._one("basins", locals())

    def fractions(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        tolerance: float = 0.0,
        polish: bool = True,
        residual: float = 1e-10,
        max_orbit_period: int = 32,
        n_points: int = 64,
        mirror_threshold: float = 0.3,
        extend: bool = True,
        budget: float = 1.0,
        n_sample: int = 24,
        lifetime_confidence: float = 0.95,
        threshold: float = 0.3,
        look_back: int = 3,
        connect: bool = True,
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Axes:
        """Draw basin fractions over the swept parameter, as stacked bands.

        Parameters
        ----------
        at
            Value of an axis that the figure does not show.
        nearest
            Use the axes' values nearest to `at`, and print them; otherwise `at` must match.
        degrees
            Use degrees instead of radians.
        width
            Width of the figure; 85 is a journal's column [mm] (40 or more, at most 1000).
        xlim
            Range of the horizontal axis, in its unit.
        ylim
            Range of the vertical axis, in its unit.
        style
            Style of matplotlib that changes magpend's: its name, or a style file.
        dpi
            Resolution; by default 200, or that of the style [1/in] (20 or more, at most 2400).
        tolerance
            Largest distance of a closed cell from its orbit, in units of the states' scales; 0 stands for ten times the
            run's closure tolerance, at least 1e-4 (0 or more).
        polish
            Refine orbits by Newton's method, which integrates a point per orbit.
        residual
            Scaled residual at which Newton's method has converged (above 0).
        max_orbit_period
            Longest orbit period that is sought in cells that are not closed [drive periods or returns] (1 or more).
        n_points
            Section points stored per attractor (1 or more).
        mirror_threshold
            Largest distance of a mirror partner from the image (above 0).
        extend
            Extend the integration of sample cells that are on no known orbit, to find their sets.
        budget
            Longest extension at a parameter point, in units of the run's own integration there (0 or more).
        n_sample
            Number of cells in the first sample that is extended (1 or more).
        lifetime_confidence
            Level of the intervals of lifetimes (above 0, below 1).
        threshold
            Matching: largest distance between sets with one id (above 0).
        look_back
            Matching: steps over which an id is remembered (1 or more).
        connect
            Matching: follow closed orbits along the axes by integration; otherwise match by distance.
        ax
            Axes to draw into; for a figure of one panel.
        figure
            Empty figure or subfigure to draw into. By default pyplot makes a figure.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Axes
            The axes drawn into.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._one("fractions", locals())

    def regimes(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        tolerance: float = 0.0,
        polish: bool = True,
        residual: float = 1e-10,
        max_orbit_period: int = 32,
        n_points: int = 64,
        mirror_threshold: float = 0.3,
        extend: bool = True,
        budget: float = 1.0,
        n_sample: int = 24,
        lifetime_confidence: float = 0.95,
        threshold: float = 0.3,
        look_back: int = 3,
        connect: bool = True,
        show: Literal["periods", "attractors", "number"] = "periods",
        curves: str = "",
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Any:
        """Draw a map of two swept parameters: coexisting periods or attractors, or their number.

        Parameters
        ----------
        at
            Value of an axis that the figure does not show.
        nearest
            Use the axes' values nearest to `at`, and print them; otherwise `at` must match.
        degrees
            Use degrees instead of radians.
        width
            Width of the figure; 85 is a journal's column [mm] (40 or more, at most 1000).
        xlim
            Range of the horizontal axis, in its unit.
        ylim
            Range of the vertical axis, in its unit.
        style
            Style of matplotlib that changes magpend's: its name, or a style file.
        dpi
            Resolution; by default 200, or that of the style [1/in] (20 or more, at most 2400).
        tolerance
            Largest distance of a closed cell from its orbit, in units of the states' scales; 0 stands for ten times the
            run's closure tolerance, at least 1e-4 (0 or more).
        polish
            Refine orbits by Newton's method, which integrates a point per orbit.
        residual
            Scaled residual at which Newton's method has converged (above 0).
        max_orbit_period
            Longest orbit period that is sought in cells that are not closed [drive periods or returns] (1 or more).
        n_points
            Section points stored per attractor (1 or more).
        mirror_threshold
            Largest distance of a mirror partner from the image (above 0).
        extend
            Extend the integration of sample cells that are on no known orbit, to find their sets.
        budget
            Longest extension at a parameter point, in units of the run's own integration there (0 or more).
        n_sample
            Number of cells in the first sample that is extended (1 or more).
        lifetime_confidence
            Level of the intervals of lifetimes (above 0, below 1).
        threshold
            Matching: largest distance between sets with one id (above 0).
        look_back
            Matching: steps over which an id is remembered (1 or more).
        connect
            Matching: follow closed orbits along the axes by integration; otherwise match by distance.
        show
            Property that is coloured.
        curves
            Run along one axis whose bifurcation curves are drawn over the map.
        ax
            Axes to draw into; for a figure of one panel.
        figure
            Empty figure or subfigure to draw into. By default pyplot makes a figure.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Any
            The axes; an array of axes if there are several panels.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._either("regimes", locals())

    @overload
    def lyapunov(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        state: str = "",
        spectrum: bool = False,
        as_map: Literal[False] = False,
        per: Literal["s", "period"] = "s",
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Panels: ...

    @overload
    def lyapunov(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        state: str = "",
        spectrum: bool = False,
        as_map: Literal[True],
        per: Literal["s", "period"] = "s",
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Axes: ...

    def lyapunov(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        state: str = "",
        spectrum: bool = False,
        as_map: bool = False,
        per: Literal["s", "period"] = "s",
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Any:
        """Draw Lyapunov exponents, under the bifurcation diagram or as a map over two parameters.

        Parameters
        ----------
        at
            Value of an axis that the figure does not show.
        nearest
            Use the axes' values nearest to `at`, and print them; otherwise `at` must match.
        degrees
            Use degrees instead of radians.
        width
            Width of the figure; 85 is a journal's column [mm] (40 or more, at most 1000).
        xlim
            Range of the horizontal axis, in its unit.
        ylim
            Range of the vertical axis, in its unit.
        style
            Style of matplotlib that changes magpend's: its name, or a style file.
        dpi
            Resolution; by default 200, or that of the style [1/in] (20 or more, at most 2400).
        state
            State to draw; by default the model's first.
        spectrum
            Draw all stored exponents, not only the largest.
        as_map
            Draw a map over two parameters instead of a diagram over one.
        per
            Exponents per second, or per drive period or return.
        ax
            Axes to draw into; for a figure of one panel.
        figure
            Empty figure or subfigure to draw into. By default pyplot makes a figure.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Any
            Array of the panels' axes, without colour bars. With ``as_map=True``: the axes drawn into.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._either("lyapunov", locals())

    def convergence(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        exponent: int = 1,
        per: Literal["s", "period"] = "s",
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Panels:
        """Draw the convergence of the Lyapunov exponents of the cells at one parameter point.

        Parameters
        ----------
        at
            Value of an axis that the figure does not show.
        nearest
            Use the axes' values nearest to `at`, and print them; otherwise `at` must match.
        degrees
            Use degrees instead of radians.
        width
            Width of the figure; 85 is a journal's column [mm] (40 or more, at most 1000).
        xlim
            Range of the horizontal axis, in its unit.
        ylim
            Range of the vertical axis, in its unit.
        style
            Style of matplotlib that changes magpend's: its name, or a style file.
        dpi
            Resolution; by default 200, or that of the style [1/in] (20 or more, at most 2400).
        exponent
            Index of the exponent; 1 is the largest (1 or more).
        per
            Exponents per second, or per drive period or return.
        ax
            Axes to draw into; for a figure of one panel.
        figure
            Empty figure or subfigure to draw into. By default pyplot makes a figure.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Panels
            Array of the panels' axes, without colour bars.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._several("convergence", locals())

    def dimension(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        tolerance: float = 0.0,
        polish: bool = True,
        residual: float = 1e-10,
        max_orbit_period: int = 32,
        n_points: int = 64,
        mirror_threshold: float = 0.3,
        extend: bool = True,
        budget: float = 1.0,
        n_sample: int = 24,
        lifetime_confidence: float = 0.95,
        threshold: float = 0.3,
        look_back: int = 3,
        connect: bool = True,
        theiler: int = 1,
        n_max: int = 10000,
        floor: float = 1e-06,
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Panels:
        """Draw the correlation sum of the chaotic sections of one parameter point, with fit and local slope.

        Parameters
        ----------
        at
            Value of a swept parameter; by default all values.
        nearest
            Use the axes' values nearest to `at`, and print them; otherwise `at` must match.
        degrees
            Use degrees instead of radians.
        width
            Width of the figure; 85 is a journal's column [mm] (40 or more, at most 1000).
        xlim
            Range of the horizontal axis, in its unit.
        ylim
            Range of the vertical axis, in its unit.
        style
            Style of matplotlib that changes magpend's: its name, or a style file.
        dpi
            Resolution; by default 200, or that of the style [1/in] (20 or more, at most 2400).
        tolerance
            Largest distance of a closed cell from its orbit, in units of the states' scales; 0 stands for ten times the
            run's closure tolerance, at least 1e-4 (0 or more).
        polish
            Refine orbits by Newton's method, which integrates a point per orbit.
        residual
            Scaled residual at which Newton's method has converged (above 0).
        max_orbit_period
            Longest orbit period that is sought in cells that are not closed [drive periods or returns] (1 or more).
        n_points
            Section points stored per attractor (1 or more).
        mirror_threshold
            Largest distance of a mirror partner from the image (above 0).
        extend
            Extend the integration of sample cells that are on no known orbit, to find their sets.
        budget
            Longest extension at a parameter point, in units of the run's own integration there (0 or more).
        n_sample
            Number of cells in the first sample that is extended (1 or more).
        lifetime_confidence
            Level of the intervals of lifetimes (above 0, below 1).
        threshold
            Matching: largest distance between sets with one id (above 0).
        look_back
            Matching: steps over which an id is remembered (1 or more).
        connect
            Matching: follow closed orbits along the axes by integration; otherwise match by distance.
        theiler
            Theiler window: pairs of sections at most so far apart in time are left out (0 or more).
        n_max
            Most section points of an attractor (100 or more).
        floor
            Smallest resolved distance, in units of the states' scales (above 0).
        ax
            Axes to draw into; for a figure of one panel.
        figure
            Empty figure or subfigure to draw into. By default pyplot makes a figure.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Panels
            Array of the panels' axes, without colour bars.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._several("dimension", locals())

    def branches(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        state: str = "",
        parameter: str = "",
        low: float | None = None,
        high: float | None = None,
        max_period: int = 0,
        generations: int = 3,
        recurrences: int = 0,
        over: str = "",
        posterior: str = "",
        shown: int | None = None,
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Axes:
        """Draw branches of periodic orbits over the bifurcation diagram: solid stable, dashed unstable.

        Parameters
        ----------
        at
            Value of an axis that the figure does not show.
        nearest
            Use the axes' values nearest to `at`, and print them; otherwise `at` must match.
        degrees
            Use degrees instead of radians.
        width
            Width of the figure; 85 is a journal's column [mm] (40 or more, at most 1000).
        xlim
            Range of the horizontal axis, in its unit.
        ylim
            Range of the vertical axis, in its unit.
        style
            Style of matplotlib that changes magpend's: its name, or a style file.
        dpi
            Resolution; by default 200, or that of the style [1/in] (20 or more, at most 2400).
        state
            State to draw; by default the model's first.
        parameter
            Continuation parameter: a parameter, or frequency_hz; by default the swept one.
        low
            Least value; by default the run's [SI].
        high
            Largest value; by default the run's [SI].
        max_period
            Longest orbit period of a branch; 0 follows all orbits that attract cells, and doublings up to the longest
            of them, at least up to 4 [drive periods or returns] (0 or more).
        generations
            Number of generations of bifurcating branches that are followed (0 or more).
        recurrences
            Also start from orbits up to this period, near close recurrences of bounded cells (0 or more).
        over
            Run whose diagram is drawn below; it must sweep the same parameter. By default DIR.
        posterior
            Directory of magpend identify posterior whose 95 % bands are drawn.
        shown
            Longest orbit period that is drawn [drive periods or returns] (1 or more).
        ax
            Axes to draw into; for a figure of one panel.
        figure
            Empty figure or subfigure to draw into. By default pyplot makes a figure.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Axes
            The axes drawn into.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._one("branches", locals())

    def multipliers(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        parameter: str = "",
        low: float | None = None,
        high: float | None = None,
        max_period: int = 0,
        generations: int = 3,
        recurrences: int = 0,
        branch: int = 0,
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Axes:
        """Draw the Floquet multipliers along a branch in the complex plane, with the unit circle.

        Parameters
        ----------
        at
            Value of an axis that the figure does not show.
        nearest
            Use the axes' values nearest to `at`, and print them; otherwise `at` must match.
        degrees
            Use degrees instead of radians.
        width
            Width of the figure; 85 is a journal's column [mm] (40 or more, at most 1000).
        xlim
            Range of the horizontal axis, in its unit.
        ylim
            Range of the vertical axis, in its unit.
        style
            Style of matplotlib that changes magpend's: its name, or a style file.
        dpi
            Resolution; by default 200, or that of the style [1/in] (20 or more, at most 2400).
        parameter
            Continuation parameter: a parameter, or frequency_hz; by default the swept one.
        low
            Least value; by default the run's [SI].
        high
            Largest value; by default the run's [SI].
        max_period
            Longest orbit period of a branch; 0 follows all orbits that attract cells, and doublings up to the longest
            of them, at least up to 4 [drive periods or returns] (0 or more).
        generations
            Number of generations of bifurcating branches that are followed (0 or more).
        recurrences
            Also start from orbits up to this period, near close recurrences of bounded cells (0 or more).
        branch
            Index of the branch, as in the table (0 or more).
        ax
            Axes to draw into; for a figure of one panel.
        figure
            Empty figure or subfigure to draw into. By default pyplot makes a figure.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Axes
            The axes drawn into.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._one("multipliers", locals())

    def curves(
        self,
        *,
        second: str,
        second_low: float,
        second_high: float,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        parameter: str = "",
        low: float | None = None,
        high: float | None = None,
        max_period: int = 0,
        generations: int = 3,
        recurrences: int = 0,
        curve_period: int = 0,
        over: str = "",
        show: Literal["periods", "attractors", "number"] = "periods",
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Axes:
        """Draw curves of folds, period doublings and Neimark-Sacker points in the plane of two parameters.

        Parameters
        ----------
        second
            Second parameter: its name, such as q, or frequency_hz.
        second_low
            Least value of the second parameter [SI].
        second_high
            Largest value of the second parameter [SI].
        at
            Value of an axis that the figure does not show.
        nearest
            Use the axes' values nearest to `at`, and print them; otherwise `at` must match.
        degrees
            Use degrees instead of radians.
        width
            Width of the figure; 85 is a journal's column [mm] (40 or more, at most 1000).
        xlim
            Range of the horizontal axis, in its unit.
        ylim
            Range of the vertical axis, in its unit.
        style
            Style of matplotlib that changes magpend's: its name, or a style file.
        dpi
            Resolution; by default 200, or that of the style [1/in] (20 or more, at most 2400).
        parameter
            Continuation parameter: a parameter, or frequency_hz; by default the swept one.
        low
            Least value; by default the run's [SI].
        high
            Largest value; by default the run's [SI].
        max_period
            Longest orbit period of a branch; 0 follows all orbits that attract cells, and doublings up to the longest
            of them, at least up to 4 [drive periods or returns] (0 or more).
        generations
            Number of generations of bifurcating branches that are followed (0 or more).
        recurrences
            Also start from orbits up to this period, near close recurrences of bounded cells (0 or more).
        curve_period
            Longest orbit period; 0 takes all periods of the branches [drive periods or returns] (0 or more).
        over
            Run over both parameters whose map of regimes is drawn below.
        show
            Property of the map that is coloured.
        ax
            Axes to draw into; for a figure of one panel.
        figure
            Empty figure or subfigure to draw into. By default pyplot makes a figure.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Axes
            The axes drawn into.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._one("curves", locals())

    def rotation(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Axes:
        """Draw rotation numbers over a parameter, with the steps p/q (the devil's staircase), or as a map over two.

        Parameters
        ----------
        at
            Value of an axis that the figure does not show.
        nearest
            Use the axes' values nearest to `at`, and print them; otherwise `at` must match.
        degrees
            Use degrees instead of radians.
        width
            Width of the figure; 85 is a journal's column [mm] (40 or more, at most 1000).
        xlim
            Range of the horizontal axis, in its unit.
        ylim
            Range of the vertical axis, in its unit.
        style
            Style of matplotlib that changes magpend's: its name, or a style file.
        dpi
            Resolution; by default 200, or that of the style [1/in] (20 or more, at most 2400).
        ax
            Axes to draw into; for a figure of one panel.
        figure
            Empty figure or subfigure to draw into. By default pyplot makes a figure.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Axes
            The axes drawn into.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._one("rotation", locals())

    def tongues(
        self,
        *,
        second: str,
        second_low: float,
        second_high: float,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        parameter: str = "",
        low: float | None = None,
        high: float | None = None,
        max_period: int = 0,
        generations: int = 3,
        recurrences: int = 0,
        curve_period: int = 0,
        max_denominator: int = 5,
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Axes:
        """Draw the edges of the Arnold tongues p/q in a plane, over the map of rotation numbers if the run spans it.

        Parameters
        ----------
        second
            Second parameter: its name, such as q, or frequency_hz.
        second_low
            Least value of the second parameter [SI].
        second_high
            Largest value of the second parameter [SI].
        at
            Value of a further axis of the run: the row on which tongues are searched.
        nearest
            Use the axes' values nearest to `at`, and print them; otherwise `at` must match.
        degrees
            Use degrees instead of radians.
        width
            Width of the figure; 85 is a journal's column [mm] (40 or more, at most 1000).
        xlim
            Range of the horizontal axis, in its unit.
        ylim
            Range of the vertical axis, in its unit.
        style
            Style of matplotlib that changes magpend's: its name, or a style file.
        dpi
            Resolution; by default 200, or that of the style [1/in] (20 or more, at most 2400).
        parameter
            Continuation parameter: a parameter, or frequency_hz; by default the swept one.
        low
            Least value; by default the run's [SI].
        high
            Largest value; by default the run's [SI].
        max_period
            Longest orbit period of a branch; 0 follows all orbits that attract cells, and doublings up to the longest
            of them, at least up to 4 [drive periods or returns] (0 or more).
        generations
            Number of generations of bifurcating branches that are followed (0 or more).
        recurrences
            Also start from orbits up to this period, near close recurrences of bounded cells (0 or more).
        curve_period
            Longest orbit period; 0 takes all periods of the branches [drive periods or returns] (0 or more).
        max_denominator
            Largest q of the tongues p/q (1 or more, at most 64).
        ax
            Axes to draw into; for a figure of one panel.
        figure
            Empty figure or subfigure to draw into. By default pyplot makes a figure.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Axes
            The axes drawn into.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._one("tongues", locals())

    def manifolds(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        max_period: int = 1,
        starts: int = 400,
        rounds: int = 6,
        seed: int = 0,
        length: float = 20.0,
        chord: float = 0.02,
        most: int = 20000,
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Axes:
        """Draw the stable and unstable manifolds of saddle orbits, over the basins of a run on a grid of two states.

        Parameters
        ----------
        at
            Value of an axis of the run, for the parameter point.
        nearest
            Use the axes' values nearest to `at`, and print them; otherwise `at` must match.
        degrees
            Use degrees instead of radians.
        width
            Width of the figure; 85 is a journal's column [mm] (40 or more, at most 1000).
        xlim
            Range of the horizontal axis, in its unit.
        ylim
            Range of the vertical axis, in its unit.
        style
            Style of matplotlib that changes magpend's: its name, or a style file.
        dpi
            Resolution; by default 200, or that of the style [1/in] (20 or more, at most 2400).
        max_period
            Longest orbit period [drive periods or returns] (1 or more).
        starts
            Number of starts for each period: half of them sections of cells, half random (2 or more).
        rounds
            Most rounds in which known orbits are deflated (0 or more).
        seed
            Seed of the random starts (0 or more).
        length
            Length of each side, in units of the states' scales (above 0).
        chord
            Longest chord, in units of the states' scales (above 0).
        most
            Most points of each side (10 or more).
        ax
            Axes to draw into; for a figure of one panel.
        figure
            Empty figure or subfigure to draw into. By default pyplot makes a figure.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Axes
            The axes drawn into.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._one("manifolds", locals())

    def drift(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        state: str = "",
        moving: str = "",
        over: str = "",
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Axes:
        """Draw sections over a parameter that moves, coloured by the swept number, over the diagram of another run.

        Parameters
        ----------
        at
            Value of an axis that the figure does not show.
        nearest
            Use the axes' values nearest to `at`, and print them; otherwise `at` must match.
        degrees
            Use degrees instead of radians.
        width
            Width of the figure; 85 is a journal's column [mm] (40 or more, at most 1000).
        xlim
            Range of the horizontal axis, in its unit.
        ylim
            Range of the vertical axis, in its unit.
        style
            Style of matplotlib that changes magpend's: its name, or a style file.
        dpi
            Resolution; by default 200, or that of the style [1/in] (20 or more, at most 2400).
        state
            State to draw; by default the model's first.
        moving
            Moving parameter; by default the only one.
        over
            Run with constant parameters that sweeps the moving one; its diagram is drawn below.
        ax
            Axes to draw into; for a figure of one panel.
        figure
            Empty figure or subfigure to draw into. By default pyplot makes a figure.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Axes
            The axes drawn into.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._one("drift", locals())

    def resilience(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        tolerance: float = 0.0,
        polish: bool = True,
        residual: float = 1e-10,
        max_orbit_period: int = 32,
        n_points: int = 64,
        mirror_threshold: float = 0.3,
        extend: bool = True,
        budget: float = 1.0,
        n_sample: int = 24,
        lifetime_confidence: float = 0.95,
        threshold: float = 0.3,
        look_back: int = 3,
        connect: bool = True,
        states: str = "",
        phases: int = 8,
        largest: float = 2.0,
        norm: Literal["euclidean", "largest"] = "euclidean",
        directions: int = 64,
        confirmations: int = 256,
        within: int = 20,
        near: float = 0.01,
        timed: int = 256,
        interval: Literal["wilson", "clopper-pearson"] = "wilson",
        confidence: float = 0.95,
        seed: int = 0,
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Panels:
        """Draw basin stability, critical shocks and arrival times of the attractors, over the swept parameter.

        Attractors stand side by side if nothing is swept. Bars show intervals.

        Parameters
        ----------
        at
            Value of an axis of the run; by default all parameter points.
        nearest
            Use the axes' values nearest to `at`, and print them; otherwise `at` must match.
        degrees
            Use degrees instead of radians.
        width
            Width of the figure; 85 is a journal's column [mm] (40 or more, at most 1000).
        xlim
            Range of the horizontal axis, in its unit.
        ylim
            Range of the vertical axis, in its unit.
        style
            Style of matplotlib that changes magpend's: its name, or a style file.
        dpi
            Resolution; by default 200, or that of the style [1/in] (20 or more, at most 2400).
        tolerance
            Largest distance of a closed cell from its orbit, in units of the states' scales; 0 stands for ten times the
            run's closure tolerance, at least 1e-4 (0 or more).
        polish
            Refine orbits by Newton's method, which integrates a point per orbit.
        residual
            Scaled residual at which Newton's method has converged (above 0).
        max_orbit_period
            Longest orbit period that is sought in cells that are not closed [drive periods or returns] (1 or more).
        n_points
            Section points stored per attractor (1 or more).
        mirror_threshold
            Largest distance of a mirror partner from the image (above 0).
        extend
            Extend the integration of sample cells that are on no known orbit, to find their sets.
        budget
            Longest extension at a parameter point, in units of the run's own integration there (0 or more).
        n_sample
            Number of cells in the first sample that is extended (1 or more).
        lifetime_confidence
            Level of the intervals of lifetimes (above 0, below 1).
        threshold
            Matching: largest distance between sets with one id (above 0).
        look_back
            Matching: steps over which an id is remembered (1 or more).
        connect
            Matching: follow closed orbits along the axes by integration; otherwise match by distance.
        states
            States that a shock changes, separated by commas; by default the rates.
        phases
            Phases of a drive period, or of a flow's orbit, at which shocks are tried (1 or more).
        largest
            Largest shock that is tried, in units of the states' scales (above 0).
        norm
            Size of a shock: root of the sum of squares of the scaled jumps, or the largest of them.
        directions
            Directions of shocks that change several states (4 or more).
        confirmations
            Random smaller shocks that are tried against each minimum (0 or more).
        within
            Time of the finite-time basin stability [drive periods or returns] (0 or more).
        near
            Distance from its attractor within which a trajectory has arrived, in units of the scales (above 0).
        timed
            Initial states of each parameter point whose arrival is timed (0 or more).
        interval
            Confidence interval of the shares.
        confidence
            Level of the intervals (above 0, below 1).
        seed
            Seed of directions, random shocks and timed initial states (0 or more).
        ax
            Axes to draw into; for a figure of one panel.
        figure
            Empty figure or subfigure to draw into. By default pyplot makes a figure.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Panels
            Array of the panels' axes, without colour bars.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._several("resilience", locals())

    def edge(
        self,
        *,
        between: tuple[str, str],
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        tolerance: float = 0.0,
        polish: bool = True,
        residual: float = 1e-10,
        max_orbit_period: int = 32,
        n_points: int = 64,
        mirror_threshold: float = 0.3,
        extend: bool = True,
        budget: float = 1.0,
        n_sample: int = 24,
        lifetime_confidence: float = 0.95,
        threshold: float = 0.3,
        look_back: int = 3,
        connect: bool = True,
        pairs: int = 4,
        closest: float = 1e-08,
        farthest: float = 0.0001,
        max_period: int = 1,
        returns: int = 200,
        seed: int = 0,
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Axes:
        """Draw the edge states between two attractors, over the basins of a run on a grid of two states.

        Parameters
        ----------
        between
            The two attractors: their letters or ids in the table of attractors.
        at
            Value of an axis of the run, for the parameter point.
        nearest
            Use the axes' values nearest to `at`, and print them; otherwise `at` must match.
        degrees
            Use degrees instead of radians.
        width
            Width of the figure; 85 is a journal's column [mm] (40 or more, at most 1000).
        xlim
            Range of the horizontal axis, in its unit.
        ylim
            Range of the vertical axis, in its unit.
        style
            Style of matplotlib that changes magpend's: its name, or a style file.
        dpi
            Resolution; by default 200, or that of the style [1/in] (20 or more, at most 2400).
        tolerance
            Largest distance of a closed cell from its orbit, in units of the states' scales; 0 stands for ten times the
            run's closure tolerance, at least 1e-4 (0 or more).
        polish
            Refine orbits by Newton's method, which integrates a point per orbit.
        residual
            Scaled residual at which Newton's method has converged (above 0).
        max_orbit_period
            Longest orbit period that is sought in cells that are not closed [drive periods or returns] (1 or more).
        n_points
            Section points stored per attractor (1 or more).
        mirror_threshold
            Largest distance of a mirror partner from the image (above 0).
        extend
            Extend the integration of sample cells that are on no known orbit, to find their sets.
        budget
            Longest extension at a parameter point, in units of the run's own integration there (0 or more).
        n_sample
            Number of cells in the first sample that is extended (1 or more).
        lifetime_confidence
            Level of the intervals of lifetimes (above 0, below 1).
        threshold
            Matching: largest distance between sets with one id (above 0).
        look_back
            Matching: steps over which an id is remembered (1 or more).
        connect
            Matching: follow closed orbits along the axes by integration; otherwise match by distance.
        pairs
            Pairs of initial states that are tracked (1 or more).
        closest
            Scaled distance to which a pair is bisected (1e-12 or more).
        farthest
            Scaled distance beyond which a pair is bisected again (above 0).
        max_period
            Longest period of the orbits that are sought on a path that does not settle; 0 seeks none [drive periods or
            returns] (0 or more).
        returns
            Most drive periods or returns for which a pair is tracked (16 or more).
        seed
            Seed that chooses the pairs (0 or more).
        ax
            Axes to draw into; for a figure of one panel.
        figure
            Empty figure or subfigure to draw into. By default pyplot makes a figure.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Axes
            The axes drawn into.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._one("edge", locals())

    @overload
    def escapes(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        low: Mapping[str, float] = {},
        high: Mapping[str, float] = {},
        radius: float | None = None,
        centre: Mapping[str, float] = {},
        skip: int = 0,
        stretch: int = 20,
        confidence: float = 0.95,
        show: Literal["rates"] = "rates",
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Axes: ...

    @overload
    def escapes(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        low: Mapping[str, float] = {},
        high: Mapping[str, float] = {},
        radius: float | None = None,
        centre: Mapping[str, float] = {},
        skip: int = 0,
        stretch: int = 20,
        confidence: float = 0.95,
        show: Literal["paths"],
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Panels: ...

    def escapes(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        low: Mapping[str, float] = {},
        high: Mapping[str, float] = {},
        radius: float | None = None,
        centre: Mapping[str, float] = {},
        skip: int = 0,
        stretch: int = 20,
        confidence: float = 0.95,
        show: Literal["rates", "paths"] = "rates",
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Any:
        """Draw rates of escape with intervals, over a strength with Kramers' law, or the last stretch before leaving.

        Over the strength σ of the noise, the horizontal axis is 1/σ².

        Parameters
        ----------
        at
            Value of an axis that the figure does not show.
        nearest
            Use the axes' values nearest to `at`, and print them; otherwise `at` must match.
        degrees
            Use degrees instead of radians.
        width
            Width of the figure; 85 is a journal's column [mm] (40 or more, at most 1000).
        xlim
            Range of the horizontal axis, in its unit.
        ylim
            Range of the vertical axis, in its unit.
        style
            Style of matplotlib that changes magpend's: its name, or a style file.
        dpi
            Resolution; by default 200, or that of the style [1/in] (20 or more, at most 2400).
        low
            Box: least value of a state, such as x=-0.5; a cell below it has left.
        high
            Box: largest value of a state; a cell above it has left.
        radius
            Ball: distance in units of the states' scales beyond which a cell has left (above 0).
        centre
            Ball: its centre by state; by default each cell's first section.
        skip
            Sections at the begin of the record that are not counted (0 or more).
        stretch
            Sections before leaving of which mean and spread are kept (1 or more, at most 1000).
        confidence
            Level of all intervals (above 0, below 1).
        show
            Rates over the axis, or the last stretch before leaving.
        ax
            Axes to draw into; for a figure of one panel.
        figure
            Empty figure or subfigure to draw into. By default pyplot makes a figure.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Any
            The axes drawn into. With ``show='paths'``: array of the panels' axes, without colour bars.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._either("escapes", locals())

    def density(
        self,
        *,
        at: Mapping[str, float] = {},
        nearest: bool = False,
        degrees: bool = False,
        width: float = 178.0,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        style: str | Path | list[str | Path | Mapping[str, Any]] | Mapping[str, Any] = "",
        dpi: float | None = None,
        state: str = "",
        bins: int = 200,
        bandwidth: float = 1.0,
        prominence: float = 0.05,
        skip: int = 0,
        ax: Axes | None = None,
        figure: Figure | SubFigure | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Any:
        """Draw the density of noisy section points, over an axis with its peaks: a stochastic bifurcation diagram.

        Parameters
        ----------
        at
            Value of an axis that the figure does not show.
        nearest
            Use the axes' values nearest to `at`, and print them; otherwise `at` must match.
        degrees
            Use degrees instead of radians.
        width
            Width of the figure; 85 is a journal's column [mm] (40 or more, at most 1000).
        xlim
            Range of the horizontal axis, in its unit.
        ylim
            Range of the vertical axis, in its unit.
        style
            Style of matplotlib that changes magpend's: its name, or a style file.
        dpi
            Resolution; by default 200, or that of the style [1/in] (20 or more, at most 2400).
        state
            State whose density is estimated; by default the model's first.
        bins
            Bins of the histogram (10 or more, at most 10000).
        bandwidth
            Factor of the bandwidth that Silverman's rule gives (above 0, at most 100).
        prominence
            Least height of a peak above the higher of its valleys, as a share of the highest peak (above 0, below 1).
        skip
            Sections at the begin of the record that are not counted (0 or more).
        ax
            Axes to draw into; for a figure of one panel.
        figure
            Empty figure or subfigure to draw into. By default pyplot makes a figure.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Any
            The axes; an array of axes if there are several panels.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._either("density", locals())
