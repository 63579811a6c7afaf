"""Declare the analysis of frequency responses: amplitudes and harmonics along branches of periodic orbits."""

from __future__ import annotations

from pipeline.products.branches import BranchOptions
from pipeline.products.product import Analysis, option


class ResponseOptions(BranchOptions):
    """Options of a frequency response."""

    harmonics: int = option(5, "Number of harmonics of the drive, or of the orbit of a flow.", ge=1, le=100)


RESPONSE = Analysis(
    "response",
    """Measure amplitude, mean, rms and harmonics of every state and quantity along branches, and the jumps.

    Integrates each orbit, stable or not, over its period. The amplitude is half of peak to peak; a phase is the lag
    behind the drive. Where a stable orbit ends, a trajectory is integrated with the parameter a little beyond, to see
    where it lands.""",
    ResponseOptions,
    compute="pipeline.analysis.response.analysis:response",
    table="pipeline.analysis.response.analysis:response_table",
    settle="pipeline.analysis.branches.analysis:settle_branches",
    builds_on=("branches",),
    figure="response",
    version=2,
)
