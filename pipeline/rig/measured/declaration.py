"""Define the options for analysing recorded frequency sweeps and for drawing their measured diagrams."""

from __future__ import annotations

from typing import Literal

from pipeline.products.product import WIDTH, Options, option

TRANSIENT, WINDOW_S, MAX_PERIOD = 20, 0.08, 16


class SweepOptions(Options):
    """Options for analysing recorded frequency sweeps: windows, drive edges, orbit periods."""

    transient: int = option(TRANSIENT, "Drive periods dropped after each step of the frequency.", ge=0)
    window: int | None = option(
        None, "Drive periods of a window of a slow sweep; by default detected; 0 takes steps only.", ge=0
    )
    window_s: float = option(WINDOW_S, "Width of the polynomials' window about an edge.", unit="s", gt=0.0)
    hysteresis: float | None = option(
        None, "Band about the drive's middle that an edge must cross, in its unit.", gt=0.0
    )
    max_period: int = option(MAX_PERIOD, "Longest orbit period that is detected.", unit="drive periods", ge=1)


class ComparisonOptions(SweepOptions):
    """Options for comparing a recorded frequency sweep with a run, and for the figures of the comparison."""

    state: str = option("", "State to draw; by default the first measured one.")
    degrees: bool = option(False, "Use degrees instead of radians.")
    width: float = WIDTH
    at: dict[str, float] = option({}, "Value of an axis that the figure does not show.")


class DiagramOptions(ComparisonOptions):
    """Options of a measured bifurcation diagram, drawn alone or with a computed one."""

    layout: Literal["side", "over"] = option("side", "Draw the computed diagram beside the measured one, or under it.")


class SeriesOptions(Options):
    """Options for drawing a recording beside the model's motion from the same state."""

    start_s: float | None = option(None, "Start at the first rising edge from this time on.", unit="s")
    periods: int = option(10, "Number of drive periods.", ge=1)
    window_s: float = option(WINDOW_S, "Width of the polynomials' window about an edge.", unit="s", gt=0.0)
    hysteresis: float | None = option(
        None, "Band about the drive's middle that an edge must cross, in its unit.", gt=0.0
    )
    degrees: bool = option(False, "Use degrees instead of radians.")
    width: float = WIDTH


class MeasuredBranchOptions(Options):
    """Options for measured branches of periodic orbits and their figure."""

    state: str = option("", "State that the amplitudes of a CSV table are of; by default the model's first.")
    width: float = WIDTH
