"""Declare the analysis of the phase response of limit cycles."""

from __future__ import annotations

from pipeline.analysis.spectrum.declaration import SetOptions
from pipeline.products.column import STATES, UNITS, Columns, over
from pipeline.products.product import Analysis, Figure, FigureOptions, option

_ROOM = "pipeline.analysis.phase.analysis"
_GRID = "Points along each side of the rectangle on which phases are computed, of flows with two states; 0 for none."


class PhaseOptions(SetOptions):
    """Options of the phase response of limit cycles."""

    phases: int = option(128, "Phases of the cycle at which the response is computed.", ge=2, le=4096)
    kick: dict[str, float] = option({}, "Jump of a state, for the response to a jump of finite size.")
    grid: int = option(0, _GRID, ge=0, le=1024)
    reach: float = option(0.5, "Distance of the rectangle's sides from the cycle, in extents of the cycle.", gt=0.0)


PHASE_COLUMNS: Columns = (
    *over(
        "cycle",
        attractor="attractor id",
        orbit_period="period in {periods}",
        status="whether the response is known",
        error="relative error of the response, estimated",
        contraction="largest modulus of the other multipliers",
    ),
    *over("cycle", "s", period_s="period"),
    *over("phase", cycle_phase="phase, 0 to 1: share of the period since the section point"),
    *over("cycle phase state", STATES, orbit="state at the phase"),
    *over("cycle phase state", UNITS, response="phase by which a jump of a state advances the cycle, per unit"),
    *over("cycle phase", shift="phase by which the kick advances the cycle, -1/2 to 1/2; NaN if it does not return"),
    *over("state", unit="unit of the response"),
    *over("cycle y x", asymptotic_phase="phase of the cycle to which a state tends, 0 to 1; NaN if it does not return"),
    *over("cycle x", STATES, x_state="first state along the rectangle"),
    *over("cycle y", STATES, y_state="second state along the rectangle"),
)

PHASE = Analysis(
    "phase",
    """Compute the phase response of stable limit cycles: how far a jump of a state moves them ahead or back.

    The infinitesimal response is the gradient of the phase on the cycle. With --kick also the response to a jump of
    finite size, and with --grid the phases of states around the cycle, whose contours are its isochrones.""",
    PhaseOptions,
    compute=f"{_ROOM}:phase",
    columns=PHASE_COLUMNS,
    parts=f"{_ROOM}:numbered_cycles",
    rows="cycle",
    table=f"{_ROOM}:phase_table",
    needs=f"{_ROOM}:needs_cycle",
    settle="pipeline.analysis.spectrum.motions:settle_set",
    builds_on=("attractors",),
    figure="phase",
    follows_motion=True,
)


class PhaseFigureOptions(PhaseOptions, FigureOptions):
    """Options of a figure of phase responses."""


PHASE_FIGURE = Figure(
    "phase",
    "Draw the phase response of a limit cycle over its phase, a panel for each state and one for a kick.",
    PhaseFigureOptions,
    "pipeline.analysis.phase.figure:draw_phase",
    panels="several",
)


class IsochroneOptions(PhaseOptions, FigureOptions):
    """Options of a figure of isochrones."""

    grid: int = option(161, _GRID, ge=8, le=1024)
    lines: int = option(20, "Number of isochrones, at even phases.", ge=2, le=100)


ISOCHRONES_FIGURE = Figure(
    "isochrones",
    "Draw the isochrones of a limit cycle of a flow with two states: lines of states that end in the same phase.",
    IsochroneOptions,
    "pipeline.analysis.phase.figure:draw_isochrones",
)
