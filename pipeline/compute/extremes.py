"""Compute the product ``extremes``: minimum, maximum and mean of quantities in each of the last `n_keep` periods."""

from __future__ import annotations

import numpy as np

from pipeline.compute.integrate import Job
from pipeline.products.extremes import ExtremesOptions


def extremes(job: Job, options: ExtremesOptions) -> dict[str, np.ndarray]:
    """Return the minimum, maximum and mean of each quantity, which was watched, in each recorded period.

    The dims are (branch, point, period_index, quantity, extreme); NaN where a cell failed.
    """
    assert job.cells.extremes is not None
    return {"extremes": job.cells.extremes}
