"""Declare the analysis of spectra: lines of closed orbits, densities of motions that do not close."""

from __future__ import annotations

from typing import Literal

from pipeline.products.product import Analysis, Options, option

_ROOM = "pipeline.analysis.spectrum.analysis"


class SpectraOptions(Options):
    """Options of the spectra of attractors, at a parameter point or at all."""

    at: dict[str, float] = option({}, "Value of an axis of the run; by default all values.")
    attractor: str = option("", "Letter or id of one attractor; by default all that are there.")
    channel: str = option("", "State or quantity; by default the model's first state.")
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


class SpectrumOptions(SpectraOptions):
    """Options of spectra."""

    cell: int | None = option(None, "Number of a cell: only the spectrum of the motion on which it ends.", ge=0)


SPECTRUM = Analysis(
    "spectrum",
    """Measure the spectrum of each attractor: lines of closed orbits, otherwise a density with its resolution.

    A closed orbit is integrated over exactly its period, so that no line leaks; the table has the amplitude of each. Of
    other motions the segments of one long trajectory are averaged, as scipy.signal.welch does. Of a torus the second
    frequency is given, if all its lines are combinations of two.""",
    SpectrumOptions,
    compute=f"{_ROOM}:spectrum",
    table=f"{_ROOM}:spectrum_table",
    needs=f"{_ROOM}:needs_channel",
    settle=f"{_ROOM}:settle_spectrum",
    builds_on=("attractors",),
    figure="spectrum",
)
