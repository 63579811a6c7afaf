"""Define the analyses ``chaos`` and ``dimension`` of a run."""

from __future__ import annotations

import xarray as xr

from pipeline.analysis.run import OpenRun
from pipeline.products.chaos import ChaosOptions, DimensionOptions


def chaos(run: OpenRun, options: ChaosOptions) -> xr.Dataset:
    """Compute Lyapunov exponents, dimensions and the 0-1 test for the cells and for each attractor of a run."""
    from pipeline.analysis.chaos.chaos import chaos as compute

    return compute(run.cube(), run.derive("attractors"), options)


def needs_dimension(run: OpenRun, options: DimensionOptions) -> None:
    """Raise ValueError if the options select an axis, or a value on an axis, that the run's result cube lacks."""
    from pipeline.analysis.selection import select_points

    select_points(run.cube(), options.at)


def settle_dimension(run: OpenRun, options: DimensionOptions) -> DimensionOptions:
    """Replace the selected parameter values by the nearest axis values of the run's result cube, so that stored results
    are found.
    """
    from pipeline.analysis.selection import select_points

    part = select_points(run.cube(), options.at)
    return options.model_copy(update={"at": {name: float(part[name].values[0]) for name in options.at}})


def dimension(run: OpenRun, options: DimensionOptions) -> xr.Dataset:
    """Compute the correlation dimension of each non-periodic attractor of a run."""
    from pipeline.analysis.chaos.correlation import section_dimension

    return section_dimension(run.cube(), run.derive("attractors"), options)
