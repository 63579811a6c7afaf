"""Settling as an analysis of a run (`pipeline.products.attractors`)."""

from __future__ import annotations

from typing import Any

import xarray as xr

from pipeline.products.attractors import AttractorOptions

VARIABLES = (
    "kind", "stability", "evidence", "n_cells", "n_sampled", "n_left", "n_leaving", "n_to", "time_at_risk",
    "mean_lifetime", "lifetime_low", "lifetime_high", "lyapunov_max", "lyapunov_low", "lyapunov_high",
    "closes_above", "orbit_period", "ran_out",
)  # fmt: skip
"""What the table of settling shows of the attractors of a run."""


def settling(run: Any, options: AttractorOptions) -> xr.Dataset:
    """Transient or attractor: what the extended cells of each set that does not close showed."""
    found: xr.Dataset = run.derive("attractors", **options.plain())
    return found[list(VARIABLES)]
