"""Define the analyses ``identified`` and ``attractors`` of a run."""

from __future__ import annotations

import xarray as xr

from pipeline.analysis.run import OpenRun
from pipeline.products.attractors import AttractorOptions, IdentifyOptions


def identified(run: OpenRun, options: IdentifyOptions) -> xr.Dataset:
    """Find the attractors of a run at each parameter point, without ids that connect the points."""
    from pipeline.analysis.attractors.attractors import identify

    return identify(run.cube(), options)


def attractors(run: OpenRun, options: AttractorOptions) -> xr.Dataset:
    """Find the attractors of a run, and give them ids that stay the same along the swept parameters."""
    from pipeline.analysis.attractors.attractors import match

    found = run.derive("identified", **options.part(IdentifyOptions))
    return match(found, threshold=options.threshold, look_back=options.look_back, connect=options.connect)
