"""Define the analysis ``settling`` of a run: the evidence on whether each non-periodic set attracts or is transient."""

from __future__ import annotations

import xarray as xr

from pipeline.analysis.run import OpenRun
from pipeline.products.product import Options

VARIABLES = (
    "kind",
    "stability",
    "evidence",
    "n_cells",
    "n_sampled",
    "n_left",
    "n_leaving",
    "n_sets",
    "from_set",
    "to",
    "n_to",
    "time_at_risk",
    "mean_lifetime",
    "lifetime_low",
    "lifetime_high",
    "lyapunov_max",
    "lyapunov_low",
    "lyapunov_high",
    "closes_above",
    "orbit_period",
    "ran_out",
)
"""Variables of the attractors that the settling table shows."""


def settling(run: OpenRun, options: Options) -> xr.Dataset:
    """Return the evidence on whether each non-periodic set attracts or is transient."""
    found: xr.Dataset = run.derive("attractors")
    return found[list(VARIABLES)]
