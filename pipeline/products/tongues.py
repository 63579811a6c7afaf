"""Declare the analysis of Arnold tongues: mode-locked regions p/q in a plane of two parameters."""

from __future__ import annotations

from pipeline.products.branches import CurveOptions
from pipeline.products.product import Analysis, option

_ROOM = "pipeline.analysis.branches.tongues"


class TongueOptions(CurveOptions):
    """Options for finding Arnold tongues and following their edges."""

    max_denominator: int = option(5, "Largest q of the tongues p/q.", ge=1, le=64, flag="--denominator")
    at: dict[str, float] = option({}, "Value of a further axis of the run: the row on which tongues are searched.")


TONGUES = Analysis(
    "tongues",
    """Find the Arnold tongues p/q of a plane: where motions lock to the drive, p turns in q drive periods.

    Searches one row of cells with rotation numbers for all fractions up to a denominator. Continues the folds at
    the edges of each tongue in the plane of two parameters.""",
    TongueOptions,
    compute=f"{_ROOM}:tongues",
    table=f"{_ROOM}:tongues_table",
    needs=f"{_ROOM}:needs_rotation",
    settle=f"{_ROOM}:settle_tongues",
    figure="tongues",
)
