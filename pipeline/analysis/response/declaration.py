"""Declare frequency responses (amplitudes and harmonics along branches of periodic orbits) and backbone curves."""

from __future__ import annotations

from pipeline.analysis.branches.declaration import BRANCH_COLUMNS, AlongOptions
from pipeline.products.column import STATES, UNITS, Columns, in_parts, only, over, swept
from pipeline.products.diagrams import PointOptions
from pipeline.products.product import Analysis, Figure, FigureOptions, Options, option


class ResponseOptions(AlongOptions):
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


RESPONSE_COLUMNS: Columns = (
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
    whole="all orbits are in one call of the engine",
    columns=RESPONSE_COLUMNS,
    table="pipeline.analysis.response.analysis:response_table",
    settle="pipeline.analysis.branches.intervals:settle_along",
    builds_on=("branches",),
    figure="response",
    follows_motion=True,
    version=2,
)


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


BACKBONE_COLUMNS: Columns = (
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
    compute="pipeline.analysis.response.backbone:backbone",
    whole="all modes are followed in step, and no curve twice",
    columns=BACKBONE_COLUMNS,
    table="pipeline.analysis.response.backbone:backbone_table",
    settle="pipeline.analysis.response.backbone:settle_backbone",
    builds_on=("branches", "response"),
    figure="backbone",
    follows_motion=True,
)


class ResponseFigureOptions(ResponseOptions, PointOptions):
    """Options of a figure of frequency responses."""

    channel: str = option("", "State or quantity to draw; by default the model's first state.")
    harmonic: int = option(0, "Draw the amplitude of this harmonic; 0 draws half of peak to peak.", ge=0)


class BackboneFigureOptions(BackboneOptions, FigureOptions):
    """Options of a figure of backbone curves."""


RESPONSE_FIGURE = Figure(
    "response",
    "Draw amplitude and phase along a parameter: stable solid, unstable dashed, one colour for each level of force.",
    ResponseFigureOptions,
    "pipeline.analysis.response.figure:draw",
    panels="several",
)


BACKBONE_FIGURE = Figure(
    "backbone",
    "Draw backbone curves over the frequency: phase resonance over the response, and normal modes.",
    BackboneFigureOptions,
    "pipeline.analysis.response.backbone_figure:draw_backbone",
)
