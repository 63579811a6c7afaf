"""Declare the analyses of stable and unstable manifolds."""

from __future__ import annotations

from pipeline.analysis.branches.declaration import OrbitOptions
from pipeline.products.column import STATES, Columns, over, swept
from pipeline.products.product import Analysis, Figure, FigureOptions, option

_ROOM = "pipeline.analysis.manifolds.analysis"


class ManifoldOptions(OrbitOptions):
    """Options for growing the manifolds of saddle orbits."""

    max_period: int = option(1, "Longest orbit period.", unit="drive periods or returns", ge=1, flag="--period")
    length: float = option(20.0, "Length of each side, in units of the states' scales.", gt=0.0)
    chord: float = option(0.02, "Longest chord, in units of the states' scales.", gt=0.0)
    most: int = option(20_000, "Most points of each side.", ge=10)


class TangencyOptions(OrbitOptions):
    """Options for locating first homoclinic tangencies."""

    parameter: str = option(
        ..., "Parameter along which the manifolds begin to touch (frequency_hz, omega and period, too)."
    )
    low: float = option(..., "Least value of the parameter.", unit="SI", flag="--from")
    high: float = option(..., "Largest value of the parameter.", unit="SI", flag="--to")
    max_period: int = option(1, "Longest orbit period.", unit="drive periods or returns", ge=1, flag="--period")
    length: float = option(6.0, "Length of each side, in units of the states' scales.", gt=0.0)
    chord: float = option(0.01, "Longest chord, in units of the states' scales.", gt=0.0)


MANIFOLD_COLUMNS: Columns = (
    *over(
        "curve",
        orbit="number of the orbit",
        orbit_period="period of the orbit in {periods}",
        stable="1 for a stable manifold",
        direction="side of the orbit, 1 or -1",
        n_points="points of the curve",
        end="why the curve ends",
    ),
    *over("curve point", generation="generation and place within it"),
    *over("curve point state", STATES, section="points of the curve"),
)

MANIFOLDS = Analysis(
    "manifolds",
    """Grow the stable and unstable manifolds of the saddle orbits at a parameter point, as curves.

    Saddles come from `orbits`. An unstable manifold is a curve if the orbit has one unstable multiplier, a stable one
    if it has one stable multiplier.""",
    ManifoldOptions,
    compute=f"{_ROOM}:manifolds",
    columns=MANIFOLD_COLUMNS,
    parts=f"{_ROOM}:sides",
    rows="curve",
    table=f"{_ROOM}:manifolds_table",
    needs="pipeline.analysis.branches.orbit_search:needs_point",
    builds_on=("orbits",),
    figure="manifolds",
)

TANGENCY_COLUMNS: Columns = (
    *over(
        "tangency",
        orbit="number of the orbit",
        orbit_period="period of the orbit in {periods}",
        stable_side="side of the stable manifold, 1 or -1",
        unstable_side="side of the unstable manifold, 1 or -1",
        why_not="why there is no value",
    ),
    *swept("value", "tangency", "value of the parameter at the tangency"),
)

TANGENCY = Analysis(
    "tangency",
    """Locate the first homoclinic tangencies of the saddle orbits along a parameter, to 1e-8.

    For section maps with two states. Each pair of sides of the unstable and the stable manifold is examined.""",
    TangencyOptions,
    compute=f"{_ROOM}:tangency",
    columns=TANGENCY_COLUMNS,
    parts=f"{_ROOM}:pairs_of_sides",
    rows="tangency",
    table=f"{_ROOM}:tangency_table",
    needs=f"{_ROOM}:needs_tangency",
    builds_on=("orbits",),
)


class ManifoldFigureOptions(ManifoldOptions, FigureOptions):
    """Options of a figure of manifolds."""


MANIFOLDS_FIGURE = Figure(
    "manifolds",
    "Draw the stable and unstable manifolds of saddle orbits, over the basins of a run on a grid of two states.",
    ManifoldFigureOptions,
    "pipeline.analysis.manifolds.figure:draw_manifolds",
)
