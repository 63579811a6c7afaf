"""Choose the times of the frames of an animation, and integrate its motions at these times."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from magpend_core.models.sectioned import of_flow
from pipeline.layout.vocabulary import model_attribute, section_attributes
from pipeline.products.diagrams import MOST_FRAMES, AnimationOptions
from pipeline.specification.problems import SpecError

if TYPE_CHECKING:
    import xarray as xr

    from magpend_core.models.model import Parameters

FILM_RTOL = 1e-9

MOST_CHANGE, MOST_CHANGE_OF_SPEED = 2.0, 1.1
"""Largest factor by which the speed is changed so that whole periods are shown: chosen here, or given."""


@dataclass(frozen=True)
class Moving:
    """A motion to animate: parameters, initial state, section points, period, name and colour."""

    # title of its frame, and colour of its lines
    name: str
    colour: str
    parameters: Parameters  # parameters of its model
    frequency_hz: float  # drive frequency [Hz]; any positive number for a flow
    start: np.ndarray  # state at time 0, the time of a section
    section: np.ndarray  # section points (k, n_states) to be shown; k may be 0
    period_s: float = math.nan  # period [s]; NaN if the motion does not repeat, 0 if it rests


@dataclass(frozen=True)
class Schedule:
    """Timing of an animation: speed, duration, frames, and samples between frames."""

    speed: float  # seconds of the model per second of film
    duration: float  # time of the model that the film shows [s]
    n_frames: int  # number of frames
    substeps: int  # number of samples from frame to frame
    repeats: bool  # whether the frame after the last would be the first

    @property
    def times(self) -> np.ndarray:
        """Times of all samples [s], from the first frame to the end of the last one."""
        n = self.n_frames * self.substeps
        return np.asarray(np.arange(n + 1) * (self.duration / n))


def schedule(moving: Sequence[Moving], options: AnimationOptions) -> Schedule:
    """Choose the speed and the frames of an animation, if possible such that all motions repeat when the film does.

    The speed is changed so that whole periods are shown, where all motions repeat: by `MOST_CHANGE` at most,
    of a speed that was given by `MOST_CHANGE_OF_SPEED`.

    Raises
    ------
    SpecError
        If the film has too many frames or shows too much time.
    """
    # time of a period in the film if no speed is given: slow enough to follow, fast enough to wait for
    period_in_film_s = 2.0
    per_period, most_samples = 240, 2_000_000  # samples per period, so many that lines look smooth, and in all
    cycle = min((_cycle(m) for m in moving), default=1.0)
    n_frames = max(2, round(options.seconds * options.fps))
    length = n_frames / options.fps
    duration = asked = length * (options.speed or _nice(cycle / period_in_film_s))
    common = _common([m.period_s for m in moving if m.period_s != 0.0], cycle)
    # what rests repeats whatever is shown
    whole = asked if not common else common * max(1, round(asked / common))
    most = MOST_CHANGE_OF_SPEED if options.speed else MOST_CHANGE
    repeats = common is not None and max(whole / asked, asked / whole) <= most * (1.0 + 1e-9)
    if repeats:
        duration = whole
    speed = duration / length
    substeps = max(1, math.ceil(duration / n_frames / cycle * per_period))
    problems = []
    if n_frames > MOST_FRAMES:
        problems.append(
            f"--seconds {options.seconds:g} at --fps {options.fps:g}: {n_frames} frames; at most "
            f"{MOST_FRAMES}. Lower one of the two."
        )
    if len(moving) * n_frames * substeps > most_samples:
        problems.append(
            f"--seconds {options.seconds:g} at --speed {speed:g}: {duration / cycle:.4g} periods are too "
            "many for a film; lower one of the two."
        )
    if problems:
        raise SpecError(problems)
    return Schedule(speed, duration, n_frames, substeps, repeats)


def _cycle(one: Moving) -> float:
    """Return the time unit of a motion [s]: the drive period or, without a drive, the period of the orbit."""
    periods = (one.parameters.model.clock.orbit_seconds(1, one.frequency_hz), one.period_s)
    return next((seconds for seconds in periods if seconds > 0.0), 2.0)


def _nice(value: float) -> float:
    power = 10.0 ** math.floor(math.log10(value))
    return min((factor * power for factor in (1.0, 2.0, 5.0, 10.0)), key=lambda v: abs(math.log(v / value)))


def _common(periods: Sequence[float], cycle: float) -> float | None:
    """Return the time [s] after which all motions repeat together; None if they never do, 0 if `periods` is empty."""
    if any(math.isnan(p) for p in periods):
        return None
    if not periods:
        return 0.0
    if max(periods) - min(periods) < 1e-12 * max(periods):
        return periods[0]
    counts = [p / cycle for p in periods]
    whole = [round(c) for c in counts]
    if any(w < 1 or abs(c - w) > 1e-9 * w for c, w in zip(counts, whole, strict=True)):
        return None
    return math.lcm(*whole) * cycle


def filmed(moving: Sequence[Moving], plan: Schedule) -> xr.Dataset:
    """Integrate the motions of an animation, and return them at all its sample times.

    Parameters
    ----------
    moving
        Motions of one model, at least one.
    plan
        Times of the animation.

    Returns
    -------
    Dataset
        ``orbit`` (motion, sample, state), angles not wrapped; ``section`` (motion, point, state), filled with
        NaN; for a model with a drawing ``points`` (motion, sample, place, axis) and ``fixed`` (motion,
        fixed_place, axis); ``name``, ``colour``, ``period`` [s, NaN if it does not repeat] and
        ``drive_frequency`` [Hz] by motion; ``time`` [s] by sample. The attributes hold the film's
        ``n_frames``, ``substeps``, ``speed`` and ``repeats``, and model and parameters.

    Raises
    ------
    ArithmeticError
        If a trajectory diverges.
    """
    import xarray as xr

    from magpend_core.trajectory import trajectory

    model, times = moving[0].parameters.model, plan.times
    orbits = np.stack(
        [
            np.tile(m.start, (times.size, 1))
            if m.period_s == 0.0
            else trajectory(of_flow(m.parameters), m.frequency_hz, m.start, times, rtol=FILM_RTOL, atol=FILM_RTOL)
            for m in moving
        ]
    )
    longest = max(len(m.section) for m in moving)
    section = np.full((len(moving), longest, len(model.states)), np.nan)
    for row, m in zip(section, moving, strict=True):
        row[: len(m.section)] = m.section
    units = {"units": "see state_units"}
    ds = xr.Dataset(
        {
            "orbit": (("motion", "sample", "state"), orbits, {**units, "long_name": "motion"}),
            "section": (("motion", "point", "state"), section, {**units, "long_name": "sections"}),
            "name": ("motion", [m.name for m in moving]),
            "colour": ("motion", [m.colour for m in moving]),
            "period": ("motion", [m.period_s for m in moving], {"units": "s", "long_name": "period"}),
            "drive_frequency": ("motion", [m.frequency_hz for m in moving], {"units": "Hz"}),
        },
        coords={
            "time": ("sample", times, {"units": "s", "long_name": "time since a section"}),
            "state": list(model.state_names),
        },
        attrs={
            "title": f"animation of the {model.title}",
            "n_frames": plan.n_frames,
            "substeps": plan.substeps,
            "speed": plan.speed,
            "repeats": int(plan.repeats),
            **_told(moving),
        },
    )
    return _drawn(ds, moving, orbits)


def _told(moving: Sequence[Moving]) -> dict[str, Any]:
    first = moving[0].parameters
    lines = [f"{name} = {value!r}" for name, value in first.as_dict().items()]
    told = {
        "model": model_attribute(first.model),
        "parameters": "\n".join(lines),
        "state_units": ", ".join(first.model.state_units),
        **section_attributes(first.model.crossing),
    }
    differing = [n for n in first if any(m.parameters[n] != first[n] for m in moving)]
    return told | {f"{name}_by_motion": [m.parameters[name] for m in moving] for name in differing}


def _drawn(ds: xr.Dataset, moving: Sequence[Moving], orbits: np.ndarray) -> xr.Dataset:
    """Add the positions of the points of the model's drawing over time, if the model has a drawing."""
    drawing = moving[0].parameters.model.drawing
    if drawing is None:
        return ds
    about = {"units": drawing.unit, "long_name": "place, to the right and upwards"}
    moved = [drawing.points(o, m.parameters.as_dict()) for o, m in zip(orbits, moving, strict=True)]
    places = np.stack([np.stack([one[name] for name in one], axis=-2) for one in moved])
    ds = ds.assign(points=(("motion", "sample", "place", "axis"), places, about))
    ds = ds.assign_coords(place=list(moved[0]), axis=["x", "y"])
    still = [drawing.fixed(m.parameters.as_dict()) for m in moving]
    if still[0]:
        fixed = np.stack([np.stack([np.asarray(p, np.float64) for p in one.values()]) for one in still])
        ds = ds.assign(fixed=(("motion", "fixed_place", "axis"), fixed, about))
        ds = ds.assign_coords(fixed_place=list(still[0]))
    return ds
