"""Declare the analyses of chaos: Lyapunov exponents, dimensions, 0-1 test."""

from __future__ import annotations

from pipeline.products.product import Analysis, Options, option

_ROOM = "pipeline.analysis.chaos.analysis"


class ChaosOptions(Options):
    """Options for telling regular from chaotic motion."""

    n_sigma: float = option(3.0, "Number of standard errors by which an exponent must differ from 0.", gt=0.0)
    least: float = option(0.005, "Least modulus of an exponent that counts as nonzero.", unit="1/s", ge=0.0)
    n_frequencies: int = option(100, "0-1 test: number of frequencies.", ge=10)
    stride: int = option(1, "0-1 test: step between the sections that are used.", ge=1)
    seed: int = option(0, "0-1 test: seed of the frequencies.", ge=0)
    n_max: int = option(2000, "Most section points for the correlation dimension; 0 computes none.", ge=0)


class DimensionOptions(Options):
    """Options for fitting a correlation dimension."""

    at: dict[str, float] = option({}, "Value of an axis of the run; by default all values.")
    theiler: int = option(1, "Theiler window: pairs of sections at most so far apart in time are left out.", ge=0)
    n_max: int = option(10_000, "Most section points of an attractor.", ge=100)
    floor: float = option(1e-6, "Smallest resolved distance, in units of the states' scales.", gt=0.0)


CHAOS = Analysis(
    "chaos",
    """Tell regular from chaotic attractors: exponents, multipliers, dimensions, 0-1 test.

    Prints a line per attractor, or with more than six points the ranges in which each kind of motion
    occurs. Exponents of orbits follow from their multipliers. Exponents of other sets need [products]
    lyapunov in the run's specification. The 0-1 test needs 200 sections.""",
    ChaosOptions,
    compute=f"{_ROOM}:chaos",
    table="pipeline.analysis.chaos.analysis:chaos_table",
    builds_on=("attractors",),
    figure="lyapunov",
    by_point=True,
)

DIMENSION = Analysis(
    "dimension",
    """Measure the correlation dimension of each set that attracts and does not close.

    A sample of each set is integrated further first, as in `settling`, since transients and motions that
    are still closing have no dimension. This takes seconds per parameter point. Two digits need thousands
    of sections.""",
    DimensionOptions,
    compute=f"{_ROOM}:dimension",
    table="pipeline.analysis.chaos.analysis:dimension_table",
    needs=f"{_ROOM}:needs_dimension",
    settle=f"{_ROOM}:settle_dimension",
    builds_on=("attractors",),
    figure="dimension",
    by_point=True,
)
