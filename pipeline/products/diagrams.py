"""Declare the figures that draw cells alone, and the options of films and of measured points."""

from __future__ import annotations

from typing import Literal

from pipeline.products.product import Figure, FigureOptions, Options, StateOptions, option

POSTERIOR = "Directory of magpend identify posterior whose 95 % bands are drawn."


class PointOptions(FigureOptions):
    """Options of a figure that shows measured points over its curves."""

    points: str = option("", "CSV file of measured points: a column of the axis, and one of each thing drawn.")


class BifurcationOptions(PointOptions, StateOptions):
    """Options of a bifurcation diagram."""

    quantity: str = option(
        "",
        "Quantity over each kept period instead of a state: NAME.min, NAME.max or NAME.mean; the run needs "
        "the product extremes.",
    )
    layout: Literal["overlay", "side"] = option("overlay", "Both directions in one panel, or one panel each.")
    posterior: str = option("", POSTERIOR)

    def label(self) -> str:
        """Return the part of the figure's file name that lists the options. It omits the state if a quantity is
        drawn.
        """
        return super().label() if not self.quantity else self.label_without("state")


class SectionOptions(StateOptions):
    """Options of a figure of section points at one parameter point."""

    against: str = option("", "State on the vertical axis; by default the other state's rate, or the next state.")
    colour: Literal["motion", "attractor"] = option(
        "motion", "Colour by class of motion, or by attractor; attractors are computed first."
    )


BIFURCATION_FIGURE = Figure(
    "bifurcation",
    "Draw a bifurcation diagram: section points over the swept parameter, coloured by class of motion.",
    BifurcationOptions,
    "pipeline.plots.bifurcation:draw",
    unless=("layout", "side"),
)


SECTION_FIGURE = Figure(
    "section",
    """Draw the section of one parameter point in the plane of two states.

    Choose a part with --xlim and --ylim. Many points are drawn as counts per pixel.""",
    SectionOptions,
    "pipeline.plots.section:draw",
)


MOST_FRAMES = 5000
"""Most frames of a film; it takes some minutes to draw, and some hundred megabytes as GIF."""


class AnimationOptions(Options):
    """Options of an animation of a run."""

    at: dict[str, float] = option({}, "Value of an axis of the run, for the parameter point to show.")
    nearest: bool = option(False, "Use the axes' values nearest to --at, and print them; otherwise --at must match.")
    degrees: bool = option(False, "Use degrees instead of radians.")
    portrait: str = option("", "State whose phase portrait is shown.")
    seconds: float = option(8.0, "Length of the film.", unit="s", gt=0.0, le=600.0)
    fps: float = option(25.0, "Frames per second.", unit="1/s", gt=0.0, le=120.0)
    speed: float | None = option(None, "Seconds of the model per second of film.", gt=0.0)
    size: int = option(800, "Width of a frame.", unit="pixels", ge=200, le=4000)
