"""Declare the analysis of frequency responses: amplitudes and harmonics along branches of periodic orbits."""

from __future__ import annotations

from pipeline.products.branches import BRANCH_COLUMNS, BranchOptions
from pipeline.products.column import UNITS, Columns, only, over
from pipeline.products.product import Analysis, option


class ResponseOptions(BranchOptions):
    """Options of a frequency response."""

    harmonics: int = option(5, "Number of harmonics of the drive, or of the orbit of a flow.", ge=1, le=100)


CHANNEL_COLUMNS: Columns = (
    *over("channel", channel="state or quantity", unit="unit of the channel"),
    *over("harmonic", harmonic="order of the harmonic"),
)
"""Coordinates of the measures of orbits."""


def measured(dims: str, prefix: str = "") -> Columns:
    """Return the columns of the measures of orbits that lie along some dims."""
    amounts = {
        "amplitude": "half of peak to peak",
        "mean": "mean over the period",
        "rms": "root of the mean square over the period",
        "error": "largest error of the amplitudes",
    }
    channel, harmonic = f"{dims} channel", f"{dims} channel harmonic"
    return (
        *over(channel, UNITS, **{f"{prefix}{name}": text for name, text in amounts.items()}),
        *over(
            channel, **{f"{prefix}dominant_order": "order of the largest component, in units of the drive's frequency"}
        ),
        *over(harmonic, UNITS, **{f"{prefix}harmonic_amplitude": "amplitude of the harmonic"}),
        *over(harmonic, "rad", **{f"{prefix}phase": "lag of the harmonic behind that of the drive"}),
    )


COLUMNS: Columns = (
    *only(
        BRANCH_COLUMNS,
        "orbit_period n_points origin first_end last_end frequency rotation angle parameter n_unstable side period_s "
        "kind of_branch after to_branch image bifurcation_side n_unstable_before n_unstable_after rises_before "
        "criticality normal_form normal_form_error critical_real critical_imag value bracket bifurcation_period_s",
    ),
    *CHANNEL_COLUMNS,
    *measured("branch point"),
    *measured("bifurcation", "bifurcation_"),
    *over("jump", "{parameter}", jump_beyond="value of the parameter beyond the bifurcation"),
    *over(
        "jump",
        jump_bifurcation="bifurcation at which a stable orbit ends",
        jump_rises="1 if the parameter rises",
        jump_landing="where a trajectory lands",
        jump_period="period of the orbit on which it lands",
    ),
    *over("jump channel", UNITS, jump_amplitude="half of peak to peak of the orbit on which it lands"),
)

RESPONSE = Analysis(
    "response",
    """Measure amplitude, mean, rms and harmonics of every state and quantity along branches, and the jumps.

    Integrates each orbit, stable or not, over its period. The amplitude is half of peak to peak; a phase is the lag
    behind the drive. Where a stable orbit ends, a trajectory is integrated with the parameter a little beyond, to see
    where it lands.""",
    ResponseOptions,
    compute="pipeline.analysis.response.analysis:response",
    columns=COLUMNS,
    table="pipeline.analysis.response.analysis:response_table",
    settle="pipeline.analysis.branches.analysis:settle_branches",
    builds_on=("branches",),
    figure="response",
    version=2,
)
