"""Declare the analysis of the transfer operator of the section map."""

from __future__ import annotations

from pipeline.products.product import Analysis, Options, option

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


TRANSFER = Analysis(
    "transfer",
    """Estimate the transfer operator of the section map: almost invariant sets, committors, passage and escape.

    Each pair of successive sections of a cell leads from one box of a grid to another (Ulam's method). Sets that no
    pair leaves are closed; where there are not two of them, almost invariant sets are found.""",
    TransferOptions,
    compute=f"{_ROOM}:transfer",
    table=f"{_ROOM}:transfer_table",
    needs=f"{_ROOM}:needs_pairs",
    figure="transfer",
    motions=("steady", "noisy"),
    by_point=True,
)
