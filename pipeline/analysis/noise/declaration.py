"""Declare the analyses of runs with noise: escapes, and densities with their peaks."""

from __future__ import annotations

from typing import Literal

from pipeline.products.column import STATES, Columns, over, with_parts
from pipeline.products.product import Analysis, Figure, FigureOptions, Options, option

_ROOM = "pipeline.analysis.noise"


class EscapeOptions(Options):
    """Options of an analysis of escapes: which set cells leave, and which stretch before that is kept."""

    low: dict[str, float] = option({}, "Box: least value of a state, such as x=-0.5; a cell below it has left.")
    high: dict[str, float] = option({}, "Box: largest value of a state; a cell above it has left.")
    radius: float | None = option(
        None, "Ball: distance in units of the states' scales beyond which a cell has left.", gt=0.0
    )
    centre: dict[str, float] = option({}, "Ball: its centre by state; by default each cell's first section.")
    skip: int = option(0, "Sections at the begin of the record that are not counted.", ge=0)
    stretch: int = option(20, "Sections before leaving of which mean and spread are kept.", ge=1, le=1000)
    confidence: float = option(0.95, "Level of the intervals.", gt=0.0, lt=1.0)


class DensityOptions(Options):
    """Options of the density of section points and of its peaks."""

    state: str = option("", "State whose density is estimated; by default the model's first.")
    bins: int = option(200, "Bins of the histogram.", ge=10, le=10_000)
    bandwidth: float = option(1.0, "Factor of the bandwidth that Silverman's rule gives.", gt=0.0, le=100.0)
    prominence: float = option(
        0.05, "Least height of a peak above the higher of its valleys, as a share of the highest peak.", gt=0.0, lt=1.0
    )
    skip: int = option(0, "Sections at the begin of the record that are not counted.", ge=0)


ESCAPES_COLUMNS: Columns = (
    *over(
        "* set",
        n_cells="cells that begin in the set",
        n_left="cells that left",
        at_risk="intervals at whose begin a cell was in the set",
        left_share="share of the cells that left",
        left_low="lower end of the interval of this share",
        left_high="upper end of the interval of this share",
        constant_p="p-value of a constant rate along the record",
    ),
    *over("* set", "s", interval="time between two looks at a cell"),
    *with_parts(over("* set", "1/s", rate="rate of escape"), "low", "high"),
    *over("* set", "1/s", rate_halved="rate of escape with halved steps"),
    *over("* set to", n_to="cells that left, by the set to which they went"),
    *over("* set state", STATES, exit_mean="mean state at which cells leave"),
    *over("* set state", STATES, exit_std="standard deviation of the states at which cells leave"),
    *over("* set lag", path_n="cells whose state is known so long before they leave"),
    *over("* set lag state", STATES, path_mean="mean state before leaving"),
    *over("* set lag state", STATES, path_std="standard deviation of the states before leaving"),
    *over("set", set="set in which cells begin"),
    *over("lag", lag="sections after the exit"),
    *with_parts(
        over("* set", "square of a strength", barrier="slope of the log rate over -1/strength^2, by Kramers' law"),
        "low",
        "high",
    ),
    *over(
        "* set",
        log_factor="natural logarithm of the factor of Kramers' law, of a rate in 1/s",
        n_fitted="strengths that were fitted",
        misfit_p="p-value of the misfit of Kramers' law",
    ),
)

ESCAPES = Analysis(
    "escapes",
    """Measure how cells with noise leave a set: rates with intervals, where they go, and their last stretch.

    The set is a box (--low, --high), a ball (--radius), or, without these, the class of motion that a cell
    begins in, by the model's classifier. Over an axis of a strength, rates are fitted by Kramers' law.""",
    EscapeOptions,
    compute=f"{_ROOM}.escapes:escapes",
    columns=ESCAPES_COLUMNS,
    table=f"{_ROOM}.escapes:escapes_table",
    needs=f"{_ROOM}.escapes:needs_set",
    figure="escapes",
    motions=("noisy",),
    by_point=True,
    finish=f"{_ROOM}.escapes:finish_escapes",
)

DENSITY_COLUMNS: Columns = (
    *over("* value", "1/{density_of}", density="density of the section points", smoothed="smoothed density"),
    *over("*", n_points="section points", n_effective="independent points with the same error of the mean"),
    *over("*", n_peaks="peaks of the smoothed density"),
    *over("*", "{density_of}", bandwidth="bandwidth of the kernel"),
    *over("*", "square of {density_of}", variance="variance of the state"),
    *over("*", skewness="skewness of the state", kurtosis="excess kurtosis of the state"),
    *over("* rank", "{density_of}", peak="places of the peaks, from the highest on"),
    *over("* state", STATES, mean="mean of the state"),
    *over("* state other_state", "units of the two states", covariance="covariance of two states"),
    *over("value", "{density_of}", value="value of the state"),
    *over("other_state", other_state="component of the state"),
)

DENSITY = Analysis(
    "density",
    """Estimate the density of the section points of a run with noise: histogram, moments, number of peaks.

    Over an axis this is a stochastic bifurcation diagram.""",
    DensityOptions,
    compute=f"{_ROOM}.density:density",
    whole="it counts stored section points, and integrates nothing",
    columns=DENSITY_COLUMNS,
    table=f"{_ROOM}.density:density_table",
    figure="density",
    motions=("noisy",),
)


class EscapeFigureOptions(EscapeOptions, FigureOptions):
    """Options of a figure of escapes."""

    show: Literal["rates", "paths"] = option("rates", "Rates over the axis, or the last stretch before leaving.")


class DensityFigureOptions(DensityOptions, FigureOptions):
    """Options of a figure of the density of section points."""


ESCAPES_FIGURE = Figure(
    "escapes",
    """Draw rates of escape with intervals, over a strength with Kramers' law, or the last stretch before leaving.

    Over the strength σ of the noise, the horizontal axis is 1/σ².""",
    EscapeFigureOptions,
    "pipeline.analysis.noise.figure:draw_escapes",
    needs="pipeline.analysis.noise.escapes:needs_set",
    unless=("show", "paths"),
)


DENSITY_FIGURE = Figure(
    "density",
    "Draw the density of noisy section points, over an axis with its peaks: a stochastic bifurcation diagram.",
    DensityFigureOptions,
    "pipeline.analysis.noise.figure:draw_density",
    panels="either",
)
