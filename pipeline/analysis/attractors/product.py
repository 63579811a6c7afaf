"""Compute attractors as an analysis of a run (`pipeline.products.attractors`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import xarray as xr

from pipeline.products.attractors import AttractorOptions, IdentifyOptions

if TYPE_CHECKING:
    from pipeline.store.run import Run


def identified(run: Run, options: IdentifyOptions) -> xr.Dataset:
    """Find the attractors of each parameter point of a run separately."""
    from pipeline.analysis.attractors.attractors import identify

    return identify(run.cube(), options)


def attractors(run: Any, options: AttractorOptions) -> xr.Dataset:
    """Find the attractors of a run and give them ids that follow them along its axes."""
    from pipeline.analysis.attractors.attractors import match

    found = run.derive("identified", **options.part(IdentifyOptions))
    return match(found, threshold=options.threshold, look_back=options.look_back, connect=options.connect)
