"""Declare the analysis of backbone curves: phase resonance, and nonlinear normal modes."""

from __future__ import annotations

from pipeline.products.column import STATES, Columns, in_parts, over, swept
from pipeline.products.product import Analysis, Options, option
from pipeline.products.response import CHANNEL_COLUMNS, measured

_ROOM = "pipeline.analysis.response.backbone"


class BackboneOptions(Options):
    """Options of backbone curves."""

    channel: str = option("", "State or quantity that is in quadrature with the drive; by default the first state.")
    low: float | None = option(None, "Least frequency; by default the run's.", unit="Hz", flag="--from", gt=0.0)
    high: float | None = option(None, "Largest frequency; by default the run's.", unit="Hz", flag="--to", gt=0.0)
    drive: str = option("", "Parameter that is the drive's amplitude; by default the only one that scales the drive.")
    drive_low: float | None = option(
        None, "Least amplitude of the drive; by default a hundredth of the run's.", unit="SI", flag="--drive-from"
    )
    drive_high: float | None = option(
        None, "Largest amplitude of the drive; by default twice the run's.", unit="SI", flag="--drive-to"
    )
    undamped: dict[str, float] = option(
        {}, "Value of a parameter for normal modes, such as c=0 and F=0, which switch damping and drive off."
    )
    reach: float = option(
        10.0, "Largest distance of a normal mode from its equilibrium.", unit="scales of the states", gt=0.02
    )


COLUMNS: Columns = (
    *CHANNEL_COLUMNS,
    *over(
        "curve", kind="kind of curve", n_points="points of the curve", first_end="why it begins", last_end="why it ends"
    ),
    *over("curve", "Hz", linear_frequency="frequency of the linear mode"),
    *swept("parameter", "curve point", "frequency"),
    *swept("force", "curve point", "value of the parameter that scales the drive", "{force}"),
    *over("curve point", n_unstable="multipliers outside the unit circle, -1 beyond the curve"),
    *over("curve point", residual="scaled gap between the ends of the orbit"),
    *over("curve point state", STATES, section="point of the orbit"),
    *in_parts(over("curve point multiplier", multiplier="multipliers that decide the stability"), "real", "imag"),
    *measured("curve point"),
)

BACKBONE = Analysis(
    "backbone",
    """Follow phase resonance (motion and drive in quadrature) in frequency and force; and nonlinear normal modes.

    Phase resonance starts where a branch of period 1 of the response passes a lag of 90 or -90 degrees. Normal modes
    are the periodic orbits of the system without damping and drive: give the values that switch these off by
    --undamped. They start from the linear modes of all equilibria that are found from the cells' sections and from the
    zero state.""",
    BackboneOptions,
    compute=f"{_ROOM}:backbone",
    columns=COLUMNS,
    table=f"{_ROOM}:backbone_table",
    settle=f"{_ROOM}:settle_backbone",
    builds_on=("branches", "response"),
    figure="backbone",
)
