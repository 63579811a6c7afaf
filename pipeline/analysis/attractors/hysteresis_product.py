"""Define the analysis ``hysteresis`` of a run."""

from __future__ import annotations

import xarray as xr

from pipeline.analysis.run import OpenRun
from pipeline.products.product import Options


def needs_directions(run: OpenRun, options: Options) -> None:
    """Raise ValueError unless the run is a continuation both up and down its parameter."""
    from pipeline.analysis.attractors.matching.hysteresis import check_directions

    check_directions(run.cube())


def hysteresis(run: OpenRun, options: Options) -> xr.Dataset:
    """Compute the hysteresis loops of a run and the jumps between its attractors."""
    from pipeline.analysis.attractors.matching.hysteresis import hysteresis as compute

    return compute(run.cube(), run.derive("attractors"))
