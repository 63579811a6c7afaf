"""Declare the analysis of basins of attraction."""

from __future__ import annotations

from typing import Literal

from pipeline.products.product import Analysis, Options, option

_ROOM = "pipeline.analysis.basins.analysis"


class BasinOptions(Options):
    """Options for measuring basins of attraction: fractions, basin entropy, uncertainty exponent."""

    interval: Literal["wilson", "clopper-pearson"] = option("wilson", "Confidence interval of the fractions.")
    confidence: float = option(0.95, "Level of the intervals.", gt=0.0, lt=1.0)
    box: int = option(5, "Basin entropy: side of the boxes.", unit="cells", ge=2)
    block: int = option(1, "Basin entropy: side of the bootstrap's blocks, in boxes.", ge=1)
    scaling: Literal["perturbation", "boxes", "entropy"] = option(
        "perturbation", "Uncertainty exponent: scaling that is fitted."
    )
    radius: int = option(1, "Wada test: radius of the fattened boundary.", unit="cells", ge=1)
    metric: Literal["taxicab", "chessboard"] = option("taxicab", "Wada test: distance between cells.")
    resamples: int = option(200, "Samples of each bootstrap.", ge=2)
    seed: int = option(0, "Seed of the bootstraps.", ge=0)


BASINS = Analysis(
    "basins",
    """Measure the basins of a sweep: fractions with intervals, entropy, uncertainty exponent, Wada test.

    The last three need starts on a grid.""",
    BasinOptions,
    compute=f"{_ROOM}:basins",
    table="pipeline.analysis.basins.analysis:basins_table",
    needs=f"{_ROOM}:needs_starts",
    builds_on=("attractors",),
    figure="basins",
    by_point=True,
    version=3,
)
