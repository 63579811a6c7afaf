"""Define the options of animations: parameter point, speed, length, size."""

from __future__ import annotations

from pipeline.products.product import Options, option

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
