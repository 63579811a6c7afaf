"""Settling as an analysis of a run (`pipeline.products.attractors`)."""

from __future__ import annotations

from typing import Any

import xarray as xr

from pipeline.products.attractors import AttractorOptions, SettlingOptions


def settling(run: Any, options: SettlingOptions) -> xr.Dataset:
    """Transient or attractor: a sample of every bounded set is run on."""
    from pipeline.analysis.attractors.lifetimes import lifetimes

    found = run.derive("attractors", **options.part(AttractorOptions))
    return lifetimes(run.cube(), found, options)
