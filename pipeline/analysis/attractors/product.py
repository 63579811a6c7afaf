"""Attractors, hysteresis and settling as analyses of a run (`pipeline.products.attractors`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import xarray as xr

from pipeline.products.attractors import AttractorOptions, IdentifyOptions, SettlingOptions

if TYPE_CHECKING:
    from pipeline.store.run import Run


def identified(run: Run, options: IdentifyOptions) -> xr.Dataset:
    """Attractors of each parameter point by itself: all that integrates."""
    from pipeline.analysis.attractors.attractors import identify

    return identify(run.cube(), options)


def attractors(run: Any, options: AttractorOptions) -> xr.Dataset:
    """Attractors of a run, found, named and followed along its axes."""
    from pipeline.analysis.attractors.attractors import match

    found = run.derive("identified", **options.part(IdentifyOptions))
    return match(found, threshold=options.threshold, look_back=options.look_back, connect=options.connect)


def needs_directions(run: Run, options: AttractorOptions) -> None:
    """Refuse a run that is no continuation in both directions."""
    from pipeline.analysis.attractors.hysteresis import check_directions

    check_directions(run.cube())


def hysteresis(run: Any, options: AttractorOptions) -> xr.Dataset:
    """Loops, and jumps between attractors."""
    from pipeline.analysis.attractors.hysteresis import hysteresis as compute

    return compute(run.cube(), run.derive("attractors", **options.plain()))


def settling(run: Any, options: SettlingOptions) -> xr.Dataset:
    """Transient or attractor: a sample of every bounded set is run on."""
    from pipeline.analysis.attractors.lifetimes import lifetimes

    found = run.derive("attractors", **options.part(AttractorOptions))
    return lifetimes(run.cube(), found, options)
