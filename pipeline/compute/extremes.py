"""Return the product ``extremes``: extremes and means that the integrator recorded in the last `n_keep` periods."""

from __future__ import annotations

import numpy as np

from pipeline.compute.integrate import Job
from pipeline.products.extremes import ExtremesOptions


def extremes(job: Job, options: ExtremesOptions) -> dict[str, np.ndarray]:
    """Return the minimum, maximum and mean of each quantity in each recorded period.

    Parameters
    ----------
    job
        The cells as they were integrated; the quantities were watched on the way.
    options
        Options of the product.

    Returns
    -------
    dict
        ``extremes`` with dims (branch, point, period_index, quantity, extreme); NaN where a cell failed.
    """
    assert job.cells.extremes is not None
    return {"extremes": job.cells.extremes}
