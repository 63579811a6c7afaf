"""Declare the analysis of basins of attraction."""

from __future__ import annotations

from typing import Literal

from pipeline.products.column import Columns, only, over, with_parts
from pipeline.products.product import Analysis, Figure, FigureOptions, Options, option
from pipeline.results.set_columns import IDENTIFIED_COLUMNS

_ROOM = "pipeline.analysis.basins.analysis"


class BasinOptions(Options):
    """Options for measuring basins of attraction: fractions, basin entropy, uncertainty exponent."""

    interval: Literal["wilson", "clopper-pearson"] = option("wilson", "Confidence interval of the fractions.")
    confidence: float = option(0.95, "Level of the intervals.", gt=0.0, lt=1.0)
    density: str = option(
        "1", "Density of the initial states, an expression of states and parameters; it weighs the cells in fractions."
    )
    box: int = option(
        5, "Basin entropy: side of the boxes; of scattered starts they hold as many cells.", unit="cells", ge=2
    )
    block: int = option(1, "Basin entropy: side of the bootstrap's blocks, in boxes.", ge=1)
    scaling: Literal["perturbation", "boxes", "entropy"] = option(
        "perturbation", "Uncertainty exponent: scaling that is fitted."
    )
    radius: int = option(1, "Wada test: radius of the fattened boundary.", unit="cells", ge=1)
    metric: Literal["taxicab", "chessboard"] = option("taxicab", "Wada test: distance between cells.")
    resamples: int = option(200, "Samples of each bootstrap.", ge=2)
    seed: int = option(0, "Seed of the bootstraps.", ge=0)


OTHERS = {
    "n_pending": "pending",
    "n_not_settled": "not settled",
    "n_transient": "on a transient set",
    "n_unstable": "on an unstable orbit or equilibrium",
    "n_neutral": "on a neutral set",
    "n_growing": "growing",
    "n_step_limit": "step limit",
    "n_step_underflow": "step underflow",
    "n_unreached": "unreached",
    "n_no_return": "no return",
    "n_chatter": "chatter",
}
"""Variables that count the cells without an outcome, and the reasons (`pipeline.results.outcomes.other_cells`)."""

_ERRORS = ("low", "high", "stderr")


def share_name(name: str) -> str:
    """Return the name of the share that belongs to a number of cells without an outcome."""
    return f"share_{name.removeprefix('n_')}"


COLUMNS: Columns = (
    *only(IDENTIFIED_COLUMNS, "n_sets ran_out attractor_id decision status"),
    *over("* +", outcome="attractor that the cell ends on", n_periods="{periods} integrated in all"),
    *over(
        "*",
        n_cells="cells of the parameter point",
        n_unfinished="cells that are not finished",
        n_effective="independent cells of equal weight with the same error",
        fraction_unfinished="share of the cells that are not finished",
        unseen_high="upper bound of the fraction of an attractor that no cell shows",
        unseen_high_if_all="this bound if all unfinished cells ended on one such attractor",
        exponent_r_squared="R squared of the fit of the uncertainty exponent",
        boundary_dimension="dimension of the basin boundary",
        above_ln2_surely="boundary basin entropy surely above ln 2: a fractal boundary; -1 not known",
        wada="passes the Wada merge test; -1 fewer than three labels",
    ),
    *over("*", **{name: f"cells without an outcome: {text}" for name, text in OTHERS.items()}),
    *over("*", **{share_name(name): f"share without an outcome: {text}" for name, text in OTHERS.items()}),
    *over("* epsilon", uncertain="uncertain part of the region"),
    *over("epsilon", "cells", epsilon="distance within which another outcome makes a cell uncertain"),
    *over("*", "cells", wada_distance="largest distance between boundaries, the least radius that passes"),
    *with_parts(over("*", wada_beyond="part of all cells that is off the common boundary"), *_ERRORS),
    *with_parts(over("*", uncertainty_exponent="uncertainty exponent"), *_ERRORS),
    *with_parts(
        over("*", "nat", basin_entropy="basin entropy", boundary_basin_entropy="boundary basin entropy"), *_ERRORS
    ),
    *over(
        "set",
        attractor="attractor, or -2 of cells that diverged",
        count="cells that end on it",
        n_inferred="cells that end on it by inference",
        fraction="basin fraction of all cells",
        low="lower end of the interval of the fraction",
        high="upper end of the interval of the fraction",
        fraction_if_all="fraction if all unfinished cells ended on it",
        high_if_all="upper end of the interval if all unfinished cells ended on it",
    ),
)

BASINS = Analysis(
    "basins",
    """Measure the basins of a sweep: fractions with intervals, entropy, uncertainty exponent, Wada test.

    The exponent and the test need starts on a grid.""",
    BasinOptions,
    compute=f"{_ROOM}:basins",
    columns=COLUMNS,
    table="pipeline.analysis.basins.analysis:basins_table",
    needs=f"{_ROOM}:needs_starts",
    builds_on=("attractors",),
    figure="basins",
    by_point=True,
    version=4,
)


class BasinFigureOptions(FigureOptions):
    """Options of a figure of basins of attraction."""

    shade: bool = option(False, "Darken cells that took longer to converge.")


class RegimeOptions(FigureOptions):
    """Options of a regime map over two parameters."""

    show: Literal["periods", "attractors", "number"] = option("periods", "Property that is coloured.")
    curves: str = option("", "Run along one axis whose bifurcation curves are drawn over the map.")


class FractionFigureOptions(FigureOptions):
    """Options of a figure of basin fractions."""

    density: str = option(
        "1", "Density of the initial states, an expression of states and parameters; it weighs the cells."
    )


BASINS_FIGURE = Figure(
    "basins",
    "Draw basins of attraction: the attractor on which each initial state of a grid ends.",
    BasinFigureOptions,
    "pipeline.analysis.basins.figure:draw_basins",
)


FRACTIONS_FIGURE = Figure(
    "fractions",
    "Draw basin fractions over the swept parameter, as stacked bands.",
    FractionFigureOptions,
    "pipeline.analysis.basins.fractions_figure:draw_fractions",
    needs="pipeline.analysis.basins.fractions_figure:needs_density",
)


REGIMES_FIGURE = Figure(
    "regimes",
    "Draw a map of two swept parameters: coexisting periods or attractors, or their number.",
    RegimeOptions,
    "pipeline.analysis.basins.regimes_figure:draw_regimes",
    panels="either",
)
