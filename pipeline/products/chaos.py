"""Regular or chaotic: exponents, dimensions, the 0-1 test."""

from __future__ import annotations

from pipeline.products.attractors import AttractorOptions
from pipeline.products.product import Analysis, option

_ROOM = "pipeline.analysis.chaos.product"


class ChaosOptions(AttractorOptions):
    """When motion counts as chaotic."""

    n_sigma: float = option(3.0, "Standard errors by which an exponent differs from 0.", gt=0.0)
    least: float = option(0.005, "Least modulus of an exponent that differs from 0.", unit="1/s", ge=0.0)
    n_frequencies: int = option(100, "0-1 test: number of frequencies.", ge=10)
    stride: int = option(1, "0-1 test: use every so many-th section.", ge=1)
    seed: int = option(0, "0-1 test: seed of the frequencies.", ge=0)
    n_max: int = option(
        2000,
        "Most section points of a correlation dimension; 0 leaves it out.",
        ge=0,
    )


class DimensionOptions(AttractorOptions):
    """How a correlation dimension is fitted."""

    at: dict[str, float] = option({}, "Value of a swept parameter; by default all its values.")
    theiler: int = option(1, "Pairs of sections at most so far apart in time are left out.", ge=0)
    n_max: int = option(10_000, "Most section points used of an attractor.", ge=100)
    floor: float = option(1e-6, "Distance, in units of the states' scales, that is not resolved.", gt=0.0)


CHAOS = Analysis(
    "chaos",
    """Tell regular from chaotic attractors: exponents, multipliers, dimensions, 0-1 test.

    A line per attractor, or with more than six points the ranges in which each kind of motion occurs.
    Exponents of orbits are those of their multipliers; those of other sets need [products] lyapunov in the
    run's specification, the 0-1 test 200 sections.""",
    ChaosOptions,
    compute=f"{_ROOM}:chaos",
    table="pipeline.analysis.chaos.table:chaos_table",
    needs=f"{_ROOM}:needs_chaos",
    builds_on=("attractors",),
    figure="lyapunov",
)

DIMENSION = Analysis(
    "dimension",
    """Measure the correlation dimension of each set that attracts and does not close.

    A sample of each is run on first, as `settling` does: transients and motions that are still closing have
    no dimension. Takes seconds per point, and thousands of sections for two digits.""",
    DimensionOptions,
    compute=f"{_ROOM}:dimension",
    table="pipeline.analysis.chaos.table:dimension_table",
    needs=f"{_ROOM}:needs_dimension",
    settle=f"{_ROOM}:settle_dimension",
    builds_on=("attractors",),
    figure="dimension",
)
