"""Options of animations: the point of a run, how fast, for how long, and how large."""

from __future__ import annotations

from pipeline.products.attractors import AttractorOptions
from pipeline.products.product import option

MOST_FRAMES = 5000
"""Frames of the longest film: some minutes of drawing, some hundred megabytes as GIF."""


class AnimationOptions(AttractorOptions):
    """What an animation shows of a run, and its clock."""

    at: dict[str, float] = option({}, "Value of an axis of the run: the parameter point that is shown.")
    nearest: bool = option(False, "Take the nearest values that the axes have for --at, and say which.")
    degrees: bool = option(False, "Degrees instead of radians.")
    portrait: str = option("", "State whose phase portrait is shown.")
    seconds: float = option(8.0, "Length of the film.", unit="s", gt=0.0, le=600.0)
    fps: float = option(25.0, "Frames per second.", unit="1/s", gt=0.0, le=120.0)
    speed: float | None = option(None, "Seconds of the model in a second of film.", gt=0.0)
    size: int = option(800, "Width of a frame.", unit="pixels", ge=200, le=4000)
