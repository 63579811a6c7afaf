"""Compute chaos and correlation dimension as analyses of a run (`pipeline.products.chaos`)."""

from __future__ import annotations

import xarray as xr

from pipeline.analysis.run import Run
from pipeline.products.attractors import AttractorOptions
from pipeline.products.chaos import ChaosOptions, DimensionOptions


def needs_chaos(run: Run, options: ChaosOptions) -> None:
    """Raise ValueError if no indicator of chaos can be computed: no exponents, too few sections, and orbits not
    polished.
    """
    from pipeline.analysis.chaos.chaos import check_chaos

    check_chaos(run.cube(), options)


def chaos(run: Run, options: ChaosOptions) -> xr.Dataset:
    """Compute Lyapunov exponents, dimensions and 0-1 test of the cells and of each attractor."""
    from pipeline.analysis.chaos.chaos import chaos as compute

    return compute(run.cube(), run.derive("attractors", **options.part(AttractorOptions)), options)


def needs_dimension(run: Run, options: DimensionOptions) -> None:
    """Raise ValueError if the options select an axis or an axis value that the cube lacks."""
    from pipeline.analysis.selection import select_points

    select_points(run.cube(), options.at)


def settle_dimension(run: Run, options: DimensionOptions) -> DimensionOptions:
    """Replace selected parameter values by the nearest values on the cube's axes, so that stored results are found."""
    from pipeline.analysis.selection import select_points

    part = select_points(run.cube(), options.at)
    return options.model_copy(update={"at": {name: float(part[name].values[0]) for name in options.at}})


def dimension(run: Run, options: DimensionOptions) -> xr.Dataset:
    """Compute the correlation dimension of each non-periodic attractor."""
    from pipeline.analysis.chaos.correlation import section_dimension

    return section_dimension(run.cube(), run.derive("attractors", **options.part(AttractorOptions)), options)
