"""Motions on the instants of a film's frames: what `pipeline.plots.animation` draws.

A motion begins at a section: of an attractor, of a cell, or where a start is given. It is integrated anew,
as closely as portraits are, and never read off stored sections, between which there is nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.layout.letters import letter
from pipeline.layout.vocabulary import (
    CLOSED_ORBIT,
    EQUILIBRIUM,
    frequency_of,
    model_attribute,
    parameters_of,
    section_attributes,
    start_dims,
)
from pipeline.products.animation import MOST_FRAMES, AnimationOptions
from pipeline.runs.derive import AnalysedRun, refused
from pipeline.spec.problems import SpecError

if TYPE_CHECKING:
    import xarray as xr

    from magpend_core.models.model import Model
    from magpend_core.models.parameters import Parameters

RTOL = 1e-9
MOST_MOTIONS = 8
PERIOD_IN_FILM_S = 2.0
"""What a period takes in the film if no speed is given: slow enough to follow, fast enough to wait for."""

SAMPLES_PER_PERIOD = 240
"""Lines look smooth; frames fall on samples."""

MOST_SAMPLES = 2_000_000


@dataclass(frozen=True)
class Moving:
    """One motion of a film.

    Attributes
    ----------
    name, colour : str
        For its title and its lines.
    parameters : Parameters
    frequency_hz : float
        Of the drive; of a flow anything positive.
    start : ndarray
        State at time 0, which is the instant of a section.
    section : ndarray
        Section points (k, n_states) to be shown; k may be 0.
    period_s : float
        After which it repeats; NaN if it does not.
    """

    name: str
    colour: str
    parameters: Parameters
    frequency_hz: float
    start: np.ndarray
    section: np.ndarray
    period_s: float = math.nan


@dataclass(frozen=True)
class Schedule:
    """Instants of a film.

    Attributes
    ----------
    speed : float
        Seconds of the model in a second of film.
    duration : float
        What the film shows [s].
    n_frames : int
    substeps : int
        Samples from frame to frame.
    repeats : bool
        Whether the frame after the last would be the first.
    """

    speed: float
    duration: float
    n_frames: int
    substeps: int
    repeats: bool

    @property
    def times(self) -> np.ndarray:
        """Instants of all samples [s], those of the frames and the end of the last among them."""
        n = self.n_frames * self.substeps
        return np.asarray(np.arange(n + 1) * (self.duration / n))


def of_attractors(
    run: AnalysedRun, options: AnimationOptions, letters: Sequence[str] = ()
) -> tuple[list[Moving], list[str]]:
    """Return the attractors of a parameter point of a run as motions, and what is to be said of them.

    Parameters
    ----------
    run
        The run; its attractors are found first if that was not done.
    options
        With the axes in the run's own names.
    letters
        Which, by letter; by default those with the largest shares.

    Raises
    ------
    SpecError
        If the point is not one of the run, or an attractor is not there.
    """
    from pipeline.analysis.selection import choose
    from pipeline.analysis.selection import start_dims as dims_of_starts
    from pipeline.plots import palette
    from pipeline.plots.door import attractors_of, values_of

    with refused(run.name):
        at, notes = values_of(run, options)
        found = attractors_of(run, options)
        part = choose(found, at, tuple(dims_of_starts(found)), "an animation shows one parameter point")
    here = part.isel(attractor=np.flatnonzero(part["kind"].values > 0))
    numbers, more = _chosen(run.name, here, letters)
    cast = palette.cast_of(found, part)
    parameters, frequency = _at_point(found, here)
    moving = []
    for number in numbers:
        one = here.sel(attractor=number)
        points = one["attractor_points"].transpose("point", "state").values
        moving.append(
            Moving(
                cast.names[number], cast.colours[number], parameters, frequency, points[0],
                 points[np.isfinite(points).all(axis=1)], _period(one, parameters, frequency),
            )
        )  # fmt: skip
    return moving, [*notes, *more]


def _chosen(name: str, here: xr.Dataset, letters: Sequence[str]) -> tuple[list[int], list[str]]:
    """Numbers of the attractors that are shown, and what is to be said of others."""
    there = [int(i) for i in here["attractor"].values]
    if not there:
        raise SpecError(
            [f"{name}: no attractor was found at this point; look with magpend analyse attractors."]
        )
    by_letter = {letter(i): i for i in there}
    if wrong := [text for text in letters if text.upper() not in by_letter]:
        raise SpecError([
            f"--attractor {text}: is not at this point; there: {', '.join(by_letter)}." for text in wrong
        ])  # fmt: skip
    if letters:
        chosen = list(dict.fromkeys(by_letter[text.upper()] for text in letters))
        if len(chosen) > MOST_MOTIONS:
            raise SpecError(
                [f"--attractor: {len(chosen)} are asked for; at most {MOST_MOTIONS} fit a frame."]
            )
        return chosen, []
    ranked = np.argsort(-here["share"].values, kind="stable")[:MOST_MOTIONS]
    left = len(there) - ranked.size
    more = [f"{left} more attractors are not shown; choose with --attractor LETTER"] if left > 0 else []
    return sorted(there[i] for i in ranked), more


def _at_point(ds: xr.Dataset, here: xr.Dataset) -> tuple[Parameters, float]:
    """Parameters at a point of a dataset, and the frequency there."""
    values = {str(k): float(v) for k, v in here.coords.items() if not v.ndim and v.dtype.kind == "f"}
    base = parameters_of(ds)
    base = base.replace(**{k: v for k, v in values.items() if k in base})
    return base, frequency_of(base.model, values)


def _period(one: xr.Dataset, parameters: Parameters, frequency: float) -> float:
    """Period of an attractor [s]: of what rests any, of a bounded set none."""
    kind, periods = int(one["kind"]), int(one["orbit_period"])
    if kind == EQUILIBRIUM:
        return 0.0
    if kind != CLOSED_ORBIT:
        return math.nan
    if parameters.model.crossing is None and periods and not parameters.model.autonomous:
        return periods / frequency
    return float(one["period_s"]) if "period_s" in one else math.nan


def of_cells(run: AnalysedRun, numbers: Sequence[int]) -> list[Moving]:
    """Return cells of a run as motions, from the first section that each has kept.

    Parameters
    ----------
    run
        The run.
    numbers
        Places of the cells in the cube, counted through all its dims in order, the last fastest.

    Raises
    ------
    SpecError
        If there is no such cell, or it has no sections.
    """
    from pipeline.plots.palette import COLOURS

    _refuse_recorded(run)
    cube = run.cube()
    shape, dims = cube["status"].shape, cube["status"].dims
    n = math.prod(shape)
    problems = [
        f"--cell {i}: the run has the cells 0 to {n - 1}, counted through {', '.join(map(str, dims))}."
        for i in numbers
        if not 0 <= i < n
    ]
    if len(numbers) > MOST_MOTIONS:
        problems.append(f"--cell: {len(numbers)} are asked for; at most {MOST_MOTIONS} fit a frame.")
    if problems:
        raise SpecError(problems)
    moving = []
    for number, colour in zip(numbers, COLOURS, strict=False):
        place = dict(zip(dims, np.unravel_index(number, shape), strict=True))
        one = cube.isel(place).load()
        points = one["section"].transpose("period_index", "state").values
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            from magpend_core.status import Status

            status = Status(int(one["status"]))
            problems.append(f"--cell {number}: has no sections to begin at ({status.sentence}).")
            continue
        parameters, frequency = _at_point(cube, one)
        period = int(one["orbit_period"]) / frequency if "orbit_period" in one else 0.0
        seen_by_drive = not parameters.model.autonomous and period > 0.0
        name = f"cell {number}: {_where(one)}"
        moving.append(
            Moving(
                name, colour, parameters, frequency, points[0], points, period if seen_by_drive else math.nan
            )
        )
    if problems:
        raise SpecError(problems)
    return moving


def _where(one: xr.Dataset) -> str:
    """Values that tell a cell from others."""
    said = []
    for key, value in one.coords.items():
        if value.ndim or str(key) in ("seed",):
            continue
        if value.dtype.kind == "f":
            unit = str(value.attrs.get("units", ""))
            said.append(f"{key} = {float(value):.6g}" + (f" {unit}" if unit not in ("", "1") else ""))
        elif value.dtype.kind in "UO":
            said.append(str(value.values))
    return ", ".join(said)


def _refuse_recorded(run: AnalysedRun) -> None:
    if run.spec.recorded is not None:
        raise SpecError([
            f"{run.name}: its drive is the recording {run.spec.recorded.file}; an animation takes a run at a "
            "frequency. Draw this one's sections: magpend plot section."
        ])  # fmt: skip


def of_start(
    parameters: Parameters, frequency_hz: float, state: Sequence[float], n_transient: int = 0
) -> Moving:
    """Return the motion from a start, some periods later if wanted.

    Parameters
    ----------
    parameters
        Of any model.
    frequency_hz
        Of the drive; without one, of the clock in whose periods `n_transient` counts.
    state
        At time 0, the instant of a section.
    n_transient
        Periods that pass before the film begins.

    Raises
    ------
    SpecError
        If the number of periods is below 0.
    ArithmeticError
        If the trajectory diverges.
    """
    from magpend_core.trajectory import trajectory
    from pipeline.plots.palette import COLOURS

    if n_transient < 0:
        raise SpecError([f"--transient {n_transient}: must be at least 0."])
    start = np.asarray(state, dtype=np.float64)
    if n_transient:
        begin = np.array([n_transient / frequency_hz])
        start = trajectory(_flow(parameters), frequency_hz, start, begin, rtol=RTOL, atol=RTOL)[0]
    said = ", ".join(f"{s.name} = {v:.4g}" for s, v in zip(parameters.model.states, start, strict=True))
    return Moving(said, COLOURS[0], parameters, frequency_hz, start, np.empty((0, start.size)))


def point_of_run(run: AnalysedRun, options: AnimationOptions) -> tuple[Parameters, float, list[str]]:
    """Return the parameters and the frequency of a parameter point of a run, and what is to be said of it.

    Raises
    ------
    SpecError
        If more than one point is left, or the point is not one of the run.
    """
    from pipeline.analysis.selection import select_points
    from pipeline.plots.door import values_of

    _refuse_recorded(run)
    cube = run.cube()
    with refused(run.name):
        at, notes = values_of(run, options)
        part = select_points(cube, at, purpose="an animation shows one parameter point")
    here = part.isel({d: 0 for d in part["status"].dims if d not in start_dims(part["status"].dims)})
    return (*_at_point(cube, here), notes)


def schedule(moving: Sequence[Moving], options: AnimationOptions) -> Schedule:
    """Lay the instants of a film: whole periods where all motions repeat and enough of them fit.

    Raises
    ------
    SpecError
        If the film has too many frames, or shows too much time.
    """
    cycle = min((_cycle(m) for m in moving), default=1.0)
    speed = options.speed or _nice(cycle / PERIOD_IN_FILM_S)
    asked = options.seconds * speed
    common = _common([m.period_s for m in moving if m.period_s != 0.0], cycle)
    # what rests repeats whatever is shown
    duration = asked if not common else common * max(1, round(asked / common))
    repeats = common is not None and duration <= 2.0 * asked
    if not repeats:
        duration = asked
    n_frames = max(2, round(duration / speed * options.fps))
    substeps = max(1, math.ceil(duration / n_frames / cycle * SAMPLES_PER_PERIOD))
    problems = []
    if n_frames > MOST_FRAMES:
        problems.append(
            f"--seconds {options.seconds:g} at --fps {options.fps:g}: {n_frames} frames; at most "
            f"{MOST_FRAMES}. Lower one of the two."
        )
    if len(moving) * n_frames * substeps > MOST_SAMPLES:
        problems.append(
            f"--seconds {options.seconds:g} at --speed {speed:g}: {duration / cycle:.4g} periods are too "
            "many for a film; lower one of the two."
        )
    if problems:
        raise SpecError(problems)
    return Schedule(duration * options.fps / n_frames, duration, n_frames, substeps, repeats)


def _cycle(one: Moving) -> float:
    """Time that the eye takes for a period [s]: of the drive, or of a flow's own loop."""
    if not one.parameters.model.autonomous:
        return 1.0 / one.frequency_hz
    return one.period_s if one.period_s > 0.0 else 2.0


def _nice(value: float) -> float:
    """Nearest of 1, 2, 5, 10, ... by ratio."""
    power = 10.0 ** math.floor(math.log10(value))
    return min((factor * power for factor in (1.0, 2.0, 5.0, 10.0)), key=lambda v: abs(math.log(v / value)))


def _common(periods: Sequence[float], cycle: float) -> float | None:
    """Least time after which all repeat [s]; None if there is none, 0 if all rest."""
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
    """Integrate motions over the instants of a film.

    Parameters
    ----------
    moving
        Of one model; at least one.
    plan
        The instants.

    Returns
    -------
    Dataset
        ``orbit`` (motion, sample, state), angles not wrapped; ``section`` (motion, point, state), NaN where
        one has fewer; of a model with a drawing ``points`` (motion, sample, place, axis) and ``fixed``
        (motion, fixed_place, axis); ``name``, ``colour``, ``period`` [s, NaN if it does not repeat] and
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
    orbits = np.stack([
        np.tile(m.start, (times.size, 1)) if m.period_s == 0.0
        else trajectory(_flow(m.parameters), m.frequency_hz, m.start, times, rtol=RTOL, atol=RTOL)
        for m in moving
    ])  # fmt: skip
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
        coords={"time": ("sample", times, {"units": "s", "long_name": "time since a section"}),
                "state": list(model.state_names)},
        attrs={
            "title": f"animation of the {model.title}", "n_frames": plan.n_frames, "substeps": plan.substeps,
            "speed": plan.speed, "repeats": int(plan.repeats), **_told(moving),
        },
    )  # fmt: skip
    return _drawn(ds, moving, orbits)


def _told(moving: Sequence[Moving]) -> dict[str, Any]:
    """Attributes that tell what was integrated; parameters that differ between the motions, by motion."""
    first = moving[0].parameters
    lines = [f"{name} = {value!r}" for name, value in first.as_dict().items()]
    told = {
        "model": model_attribute(first.model), "parameters": "\n".join(lines),
        "state_units": ", ".join(first.model.state_units), **section_attributes(first.model.crossing),
    }  # fmt: skip
    differing = [n for n in first if any(m.parameters[n] != first[n] for m in moving)]
    return told | {f"{name}_by_motion": [m.parameters[name] for m in moving] for name in differing}


def _drawn(ds: xr.Dataset, moving: Sequence[Moving], orbits: np.ndarray) -> xr.Dataset:
    """With the places of the points of the model's drawing."""
    drawing = _model(moving).drawing
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


def _model(moving: Sequence[Moving]) -> Model:
    return moving[0].parameters.model


def _flow(parameters: Parameters) -> Parameters:
    from magpend_core.models.sectioned import of_flow

    return of_flow(parameters)
