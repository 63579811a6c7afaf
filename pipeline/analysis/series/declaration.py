"""Declare the analysis of what a time series says of the dynamics of a motion."""

from __future__ import annotations

from pipeline.analysis.spectrum.declaration import CellOptions
from pipeline.products.column import OWN, UNITS, Columns, over
from pipeline.products.product import Analysis, Figure, FigureOptions, option

_SERIES = "pipeline.analysis.series.analysis"
_MOTIONS = "pipeline.analysis.spectrum.motions"


class SeriesOptions(CellOptions):
    """Options of what a time series says of the dynamics of a motion."""

    periods: int = option(250, "Length of the series.", unit="drive periods or returns", ge=20, le=100_000)
    samples: int = option(32, "Samples in a drive period or return.", ge=4, le=4096)
    seed: int = option(0, "Seed of the surrogates.", ge=0)


SERIES_COLUMNS: Columns = (
    *over("quantity", quantity="quantity of the series", unit="unit of the quantity", reason="why there is no value"),
    *over(
        "quantity",
        UNITS,
        value="value of the quantity",
        low="lower end of its interval",
        high="upper end of its interval",
    ),
    *over("", attractor="attractor id"),
    *over("lag", mutual_information="mutual information of the series and itself after a lag"),
    *over("lag", "s", lag="lag"),
    *over("dimension", dimension="dimension of the embedding", false_neighbours="share of false nearest neighbours"),
    *over("elapsed", "s", elapsed="time since neighbours were nearest"),
    *over(
        "elapsed",
        divergence="mean log distance of neighbours, of random pairs 0",
        fit_line="line that was fitted to it",
    ),
    *over("embedding", embedding="dimension of the embedding"),
    *over("radius", radius="radius over the standard deviation"),
    *over("embedding radius", correlation_sum="share of pairs of vectors within the radius"),
    *over("", fit_low="least radius of the fit", fit_high="largest radius of the fit"),
    *over("return", "{unit}", maximum="height of a maximum", next_maximum="height of the next maximum"),
    *over("delayed coordinate", "{unit}", vector="value, and value after the delay"),
    *over("row", "s", row="time of a vector"),
    *over("column", "s", column="time of a vector"),
    *over("row column", recurrent="1 if the two vectors are near each other"),
    *over("bin", "Hz", frequency_hz="frequency"),
    *over("bin", OWN, power="density of the channel"),
)

SERIES = Analysis(
    "series",
    """Measure period, largest exponent, dimension and recurrences of a motion's time series, each with an interval.

    The motion of one attractor or one cell is sampled like a recording, and analysed as recordings analyse does. A
    result that the length of the series forbids is not decided, and the table says why.""",
    SeriesOptions,
    version=2,
    compute=f"{_SERIES}:series",
    whole="it is of one motion",
    columns=SERIES_COLUMNS,
    table=f"{_SERIES}:series_table",
    needs=f"{_MOTIONS}:needs_motion",
    settle=f"{_MOTIONS}:settle_motion",
    builds_on=("attractors",),
    figure="series",
    follows_motion=True,
)


class SeriesFigureOptions(SeriesOptions, FigureOptions):
    """Options of a figure of a motion's time series."""


SERIES_FIGURE = Figure(
    "series",
    "Draw a motion's delay portrait, return map, divergence, correlation sums, recurrences and spectrum.",
    SeriesFigureOptions,
    "pipeline.analysis.series.figure:draw_series",
    panels="several",
)
