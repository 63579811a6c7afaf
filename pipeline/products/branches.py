"""Periodic orbits followed along a parameter, stable or not, and curves of their bifurcations."""

from __future__ import annotations

from pipeline.products.product import Analysis, Options, option

_ROOM = "pipeline.analysis.branches.product"


class BranchOptions(Options):
    """Which orbits are followed, and how far."""

    parameter: str = option(
        "",
        "What is varied: a parameter, or the drive's frequency_hz; by default what the run sweeps.",
    )
    low: float | None = option(None, "Least value; by default what the run spans.", unit="SI", flag="--from")
    high: float | None = option(None, "Largest value; by default what the run spans.", unit="SI", flag="--to")
    max_period: int = option(
        0,
        "Longest period of a branch; 0 takes all orbits that attract cells, and doublings up to the longest "
        "of them, at least up to 4.",
        unit="drive periods or returns",
        ge=0,
        flag="--period",
    )
    generations: int = option(3, "How often branches that spring from branches are followed.", ge=0)
    recurrences: int = option(
        0, "Start also from orbits, up to this period, near close recurrences of bounded cells.", ge=0
    )


class CurveOptions(BranchOptions):
    """Which bifurcations are continued, in which plane."""

    second: str = option(..., "Second parameter: its name, such as q, or the drive's frequency_hz.")
    second_low: float = option(..., "Its least value.", unit="SI", flag="--second-from")
    second_high: float = option(..., "Its largest value.", unit="SI", flag="--second-to")
    curve_period: int = option(1, "Longest period of the orbits.", unit="drive periods or returns", ge=1)


BRANCHES = Analysis(
    "branches",
    """Follow periodic orbits along a parameter, stable or not; locate and name their bifurcations.

    Starts from the closed orbits that attract cells of the run. What was left out is listed, with how to
    get it.""",
    BranchOptions,
    compute=f"{_ROOM}:branches",
    table="pipeline.analysis.branches.table:branches_table",
    settle=f"{_ROOM}:settle_branches",
    builds_on=("attractors",),
    figure="branches",
)

CURVES = Analysis(
    "curves",
    """Continue folds, period doublings and Neimark-Sacker points in the plane of two parameters.

    Takes the points that `branches` locates.""",
    CurveOptions,
    compute=f"{_ROOM}:curves",
    table="pipeline.analysis.branches.table:curves_table",
    settle=f"{_ROOM}:settle_curves",
    builds_on=("branches",),
    figure="curves",
)
