"""Declare the analysis of the transfer operator of the section map."""

from __future__ import annotations

from pipeline.products.column import UNITS, Columns, over, with_parts
from pipeline.products.product import Analysis, Figure, FigureOptions, Options, option

_ROOM = "pipeline.analysis.transfer.analysis"


class TransferOptions(Options):
    """Options of the transfer operator: the boxes of its grid, and the sets that are told apart."""

    states: str = option("", "States of the grid, separated by commas; by default all.")
    bins: int | None = option(
        None, "Boxes along each state; by default as many as give 25 pairs to a box.", ge=2, le=4096
    )
    low: dict[str, float] = option({}, "Least value of a state, such as x=-2; states below it are outside.")
    high: dict[str, float] = option({}, "Largest value of a state; states above it are outside.")
    sets: int = option(2, "Almost invariant sets, where no two sets are closed.", ge=1, le=8)
    core: float = option(0.5, "Share of a set's measure in its core, which passages reach.", gt=0.0, le=1.0)
    resamples: int = option(50, "Resamples of the cells for the errors.", ge=2, le=2000)
    confidence: float = option(0.95, "Level of the intervals.", gt=0.0, lt=1.0)
    seed: int = option(0, "Seed of the resamples.", ge=0)


TRANSFER_COLUMNS: Columns = (
    *over(
        "*",
        n_pairs="pairs of sections",
        n_boxes="boxes in which a pair begins",
        outside="share of pairs that end outside the grid",
        unknown="share of pairs that end in a box in which no pair begins",
        n_closed="closed sets, which no path leaves",
        n_sets="number of sets",
    ),
    *over("* mode", eigenvalue="slow eigenvalues on the one closed set, real part"),
    *over("* mode", eigenvalue_imaginary="slow eigenvalues on the one closed set, imaginary part"),
    *over("* axis", UNITS, width="width of the boxes"),
    *over("axis", axis="state of the grid", unit="unit of the state"),
    *over(
        "set",
        is_closed="1 if no path leaves the set",
        measure="share of the stationary measure",
        share="mean committor over all boxes: of a closed set, its share of the sampled states",
        kept="share of its measure that stays in a step",
        n_points="boxes of the set",
    ),
    *with_parts(over("set", "1/step", escape_rate="rate of escape"), "low", "high", "coarse"),
    *with_parts(
        over("set target", "steps", passage="mean steps from its core to the core of another set"),
        "low",
        "high",
        "coarse",
    ),
    *over("sample axis", UNITS, place="centre of a box"),
    *over("sample", density="stationary measure of a box, within its set"),
    *with_parts(
        over("sample", committor="probability to reach the core of its set before the others"), "low", "high", "coarse"
    ),
    *over("sample", is_core="1 in the core of its set"),
)

TRANSFER = Analysis(
    "transfer",
    """Estimate the transfer operator of the section map: almost invariant sets, committors, passage and escape.

    Each pair of successive sections of a cell leads from one box of a grid to another (Ulam's method). Sets that no
    pair leaves are closed; where there are not two of them, almost invariant sets are found.""",
    TransferOptions,
    compute=f"{_ROOM}:transfer",
    columns=TRANSFER_COLUMNS,
    table=f"{_ROOM}:transfer_table",
    needs=f"{_ROOM}:needs_pairs",
    figure="transfer",
    motions=("steady", "noisy"),
    by_point=True,
)


class TransferFigureOptions(TransferOptions, FigureOptions):
    """Options of a figure of the transfer operator's sets."""


TRANSFER_FIGURE = Figure(
    "transfer",
    "Draw the slow sets of the section map: stationary density within each, cores, and committors.",
    TransferFigureOptions,
    "pipeline.analysis.transfer.figure:draw",
    needs="pipeline.analysis.transfer.analysis:needs_pairs",
    panels="several",
)
