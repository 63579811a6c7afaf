"""Declare the analysis of spectra: lines of closed orbits, densities of motions that do not close."""

from __future__ import annotations

from typing import Literal

from pipeline.products.column import OWN, Columns, over
from pipeline.products.product import Analysis, Figure, FigureOptions, Options, option

_ROOM = "pipeline.analysis.spectrum.analysis"
_MOTIONS = "pipeline.analysis.spectrum.motions"


class SetOptions(Options):
    """Options that choose attractors of a run."""

    at: dict[str, float] = option({}, "Value of an axis of the run; by default all values.")
    attractor: str = option("", "Letter or id of one attractor; by default all that are there.")


class MotionOptions(SetOptions):
    """Options that choose motions of a run, and a quantity of them."""

    channel: str = option("", "State or quantity; by default the model's first state.")


class CellOptions(MotionOptions):
    """Options that choose motions of a run also by a cell."""

    cell: int | None = option(None, "Number of a cell: only the motion on which it ends.", ge=0)


class SpectraOptions(MotionOptions):
    """Options of the spectra of attractors, at a parameter point or at all."""

    window: str = option("hann", "Window of each segment, by its name in scipy.signal, such as hann or flattop.")
    segment: int = option(
        64, "Length of a segment; its inverse is the resolution.", unit="drive periods or returns", ge=4, le=100_000
    )
    averages: int = option(31, "Segments that are averaged; they overlap by half.", ge=1, le=10_000)
    orders: int = option(
        10, "Highest frequency that is kept, as a multiple of the drive's or of the rate of returns.", ge=1, le=100
    )
    scaling: Literal["density", "spectrum"] = option(
        "density", "Power per hertz, or power, of motions that do not close; as in scipy.signal.welch."
    )


class SpectrumOptions(SpectraOptions, CellOptions):
    """Options of spectra."""


SPECTRUM_COLUMNS: Columns = (
    *over("spectrum bin", "{unit}", amplitude="amplitude of the channel"),
    *over("spectrum bin", OWN, power="power of the channel"),
    *over("spectrum bin", "Hz", frequency_hz="frequency"),
    *over("spectrum bin", order="multiple of the drive frequency"),
    *over(
        "spectrum",
        attractor="attractor id",
        kind="kind of set",
        stability="what has been shown of the set",
        orbit_period="period in {periods}",
        share="share of the initial conditions",
        estimate="how the spectrum was estimated",
        n_averages="number of averaged segments",
        kept="share of the variance in the bins",
        n_interpolated="samples that were interpolated",
        explained="share of a torus' power at combinations of its two frequencies",
    ),
    *over("spectrum", "{unit}", error="largest error of the amplitudes"),
    *over("spectrum", OWN, variance="variance of the channel"),
    *over(
        "spectrum",
        "Hz",
        rate_hz="frequency of the drive, or mean rate of returns",
        resolution_hz="distance of two bins",
        bandwidth_hz="equivalent noise bandwidth of the window",
        first_hz="first frequency of a torus: the drive's, or that of its strongest line",
        second_hz="second frequency of a torus, up to its sign and multiples of the first",
    ),
)

SPECTRUM = Analysis(
    "spectrum",
    """Measure the spectrum of each attractor: lines of closed orbits, otherwise a density with its resolution.

    A closed orbit is integrated over exactly its period, so that no line leaks; the table has the amplitude of each. Of
    other motions the segments of one long trajectory are averaged, as scipy.signal.welch does. Of a torus the second
    frequency is given, if all its lines are combinations of two.""",
    SpectrumOptions,
    compute=f"{_ROOM}:spectrum",
    columns=SPECTRUM_COLUMNS,
    parts=f"{_ROOM}:numbered_motions",
    rows="spectrum",
    together=16,
    table=f"{_ROOM}:spectrum_table",
    needs=f"{_ROOM}:needs_channel",
    settle=f"{_MOTIONS}:settle_motion",
    builds_on=("attractors",),
    figure="spectrum",
    follows_motion=True,
)


Axis = Literal["", "order", "Hz"]


_AXIS = "Frequencies as orders, multiples of the drive's, or in hertz; by default orders where there is a drive."


class SpectrumFigureOptions(SpectrumOptions, FigureOptions):
    """Options of a figure of spectra at one parameter point."""

    axis: Axis = option("", _AXIS)


class WaterfallOptions(SpectraOptions, FigureOptions):
    """Options of a figure of spectra along a parameter."""

    scaling: Literal["density", "spectrum"] = option(
        "spectrum", "Colours show amplitudes, or power per hertz, as in scipy.signal.welch."
    )
    axis: Axis = option("", _AXIS)


SPECTRUM_FIGURE = Figure(
    "spectrum",
    "Draw the spectrum of each attractor of a parameter point: lines of closed orbits, otherwise densities.",
    SpectrumFigureOptions,
    "pipeline.analysis.spectrum.figure:draw_spectrum",
    needs="pipeline.analysis.spectrum.analysis:needs_axis",
    panels="several",
)


WATERFALL_FIGURE = Figure(
    "waterfall",
    """Draw spectra along the swept parameter, as colours.

    At each value the spectrum is that of the attractor on which most cells end, or of --attractor.""",
    WaterfallOptions,
    "pipeline.analysis.spectrum.figure:draw_waterfall",
    needs="pipeline.analysis.spectrum.analysis:needs_axis",
)
