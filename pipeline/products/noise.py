"""Declare the analyses of runs with noise: escapes, and densities with their peaks."""

from __future__ import annotations

from pipeline.products.product import Analysis, Options, option

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


ESCAPES = Analysis(
    "escapes",
    """Measure how cells with noise leave a set: rates with intervals, where they go, and their last stretch.

    The set is a box (--low, --high), a ball (--radius), or, without these, the class of motion that a cell
    begins in, by the model's classifier. Over an axis of a strength, rates are fitted by Kramers' law.""",
    EscapeOptions,
    compute=f"{_ROOM}.escapes:escapes",
    table=f"{_ROOM}.escapes:escapes_table",
    needs=f"{_ROOM}.escapes:needs_set",
    figure="escapes",
    motions=("noisy",),
    by_point=True,
    finish=f"{_ROOM}.escapes:finish_escapes",
)

DENSITY = Analysis(
    "density",
    """Estimate the density of the section points of a run with noise: histogram, moments, number of peaks.

    Over an axis this is a stochastic bifurcation diagram.""",
    DensityOptions,
    compute=f"{_ROOM}.density:density",
    table=f"{_ROOM}.density:density_table",
    figure="density",
    motions=("noisy",),
)
