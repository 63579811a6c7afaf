"""Define the analysis ``basins`` of a run."""

from __future__ import annotations

import xarray as xr

from pipeline.analysis.run import OpenRun
from pipeline.products.basins import BasinOptions


def needs_starts(run: OpenRun, options: BasinOptions) -> None:
    """Raise ValueError unless the run's cells are independent initial conditions."""
    from pipeline.analysis.basins.basins import check_starts

    check_starts(run.cube())


def basins(run: OpenRun, options: BasinOptions) -> xr.Dataset:
    """Compute the basins of attraction of a sweep: the outcomes of its cells, the basin fractions and the basin
    boundaries.
    """
    from pipeline.analysis.basins.basins import basins as compute

    found = run.derive("attractors")
    return compute(run.cube(), found, options)
