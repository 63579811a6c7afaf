"""Make an animation of motions, from a run or from an initial state, as ``magpend animate`` does."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from magpend_core.models import DEFAULT, load_model
from magpend_core.models.model import Model
from magpend_core.models.presets import Preset
from magpend_core.models.sectioned import of_flow
from pipeline.layout.vocabulary import (
    ATTRACTS,
    EQUILIBRIUM,
    PERIODIC_ORBIT,
    frequency_of,
    letter,
    parameters_of,
    start_dims,
)
from pipeline.products.diagrams import AnimationOptions
from pipeline.products.reporting import silent
from pipeline.runs import instants
from pipeline.runs.derive import AnalysedRun, Echo, Source, refused
from pipeline.runs.instants import FILM_RTOL, Moving
from pipeline.runs.naming import named
from pipeline.specification.problems import SpecError, validated

if TYPE_CHECKING:
    import xarray as xr

    from magpend_core.models.model import Parameters
    from pipeline.plots.animation import Animation


@dataclass(frozen=True)
class Start:
    """Initial state of a motion to animate, with model and parameters if there is no run.

    Attributes
    ----------
    state : mapping
        Initial values by name, see `pipeline.compute.simulate.start_of`; missing ones are 0.
    transient : int
        Periods before the film begins.
    model, frequency_hz, preset, overrides
        Model and parameters, if no run gives them.
    """

    state: Mapping[str, float] = field(default_factory=dict)
    transient: int = 0
    model: str | Mapping[str, Any] | Model = DEFAULT
    frequency_hz: float | None = None
    preset: str | Path | Preset | None = None
    overrides: Mapping[str, float] = field(default_factory=dict)


def animation(
    source: Source | None = None,
    options: Mapping[str, Any] | AnimationOptions | None = None,
    *,
    attractors: Sequence[str] = (),
    cells: Sequence[int] = (),
    start: Start | Mapping[str, float] | None = None,
    echo: Echo | None = None,
    **more: Any,
) -> Animation:
    """Make an animation of motions: the moving drawing of the model, and phase portraits.

    Parameters
    ----------
    source
        Run directory, or an opened run; None for a start without one.
    options, more
        Options of `pipeline.products.diagrams.AnimationOptions` that differ from the defaults.
    attractors
        Letters of attractors of the run. By default, without `cells` and `start`, all attractors at the
        parameter point.
    cells
        Indices of cells of the run, see `of_cells`.
    start
        A start instead: at the run's parameter point, or of a model.
    echo
        Function that prints a line.

    Returns
    -------
    Animation
        Animation that `pipeline.plots.animation.save_animation` draws and writes.

    Raises
    ------
    SpecError
        If the run lacks a requested object, or a value is out of bounds; before anything is integrated.
    ArithmeticError
        If a trajectory diverges.
    """
    from pipeline.plots.animation import plot_animation, portraits_of
    from pipeline.plots.figure import run_provenance, with_provenance

    if isinstance(options, AnimationOptions):
        wanted = options
    else:
        wanted = validated(AnimationOptions, {**(options or {}), **more})
    begun = start if isinstance(start, Start) or start is None else Start(start)
    told: dict[str, Any] = {}
    if source is None:
        shown, notes = [_alone(begun or Start())], list[str]()
    else:
        run = AnalysedRun.of(source, echo)
        wanted = named(run, wanted)  # type: ignore[assignment]
        shown, notes = _of_run(run, wanted, attractors, cells, begun)
        told = run_provenance(run)
    try:
        portraits_of(shown[0].parameters.model, wanted.portrait, len(shown), wanted.degrees)
    except ValueError as error:
        raise SpecError(str(error)) from None
    plan = instants.schedule(shown, wanted)
    for line in notes:
        (echo or silent)(line)
    data = with_provenance(instants.filmed(shown, plan).assign_attrs(fps=wanted.fps), told)
    return plot_animation(data, degrees=wanted.degrees, portrait=wanted.portrait, size=wanted.size)


def _of_run(
    run: AnalysedRun, options: AnimationOptions, attractors: Sequence[str], cells: Sequence[int], start: Start | None
) -> tuple[list[instants.Moving], list[str]]:
    from pipeline.compute.simulate import start_of

    _refuse_map(run.model)
    if cells:
        return of_cells(run, cells), []
    if start is None:
        return of_attractors(run, options, attractors)
    parameters, frequency, notes = point_of_run(run, options)
    state = start_of(run.model.flow, start.state)
    return [of_start(parameters, frequency, state, start.transient)], notes


def _alone(start: Start) -> instants.Moving:
    """Integrate a model from an initial state as a motion to animate, without a run."""
    import numpy as np

    from pipeline.compute.simulate import start_of
    from pipeline.layout.evaluation import check_states
    from pipeline.specification.tables import FREQUENCY

    model = load_model(start.model)
    _refuse_map(model)
    frequency = start.frequency_hz
    if frequency is None:
        frequency = model.clock.default_hz
    state = start_of(model, start.state)
    parameters = model.load(start.preset, **start.overrides)
    check_states(model, np.array([state]), [{**parameters, FREQUENCY: frequency}])
    return of_start(parameters, frequency, state, start.transient)


def _refuse_map(model: Model) -> None:
    if not model.clock.is_continuous:
        raise SpecError(f"{model.name} is a map, without motion between its iterations to animate; draw its section.")


MOST_MOTIONS = 8


def of_attractors(
    run: AnalysedRun, options: AnimationOptions, letters: Sequence[str] = ()
) -> tuple[list[Moving], list[str]]:
    """Return the attractors of a run at one parameter point as motions to animate, with notes on those left out.

    Parameters
    ----------
    run
        The run; its attractors are computed if they are not kept.
    options
        Options with the axes in the run's own names.
    letters
        Letters of the attractors; by default those with the largest basin fractions, or other sets if there
        are no attractors.

    Raises
    ------
    SpecError
        If the run does not have the point, or an attractor does not exist there.
    """
    from pipeline.plots import palette
    from pipeline.plots.figure import values_of
    from pipeline.results.ragged import dense
    from pipeline.results.selection import choose
    from pipeline.results.selection import start_dims as dims_of_starts

    with refused(run.name):
        at, notes = values_of(run, options)
        found = run.derive("attractors")
        part = dense(
            choose(found, at, tuple(dims_of_starts(found)), "an animation shows one parameter point"), points=True
        )
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
                cast.names[number],
                palette.GREY_OF.get(int(one["stability"]), cast.colours[number]),
                parameters,
                frequency,
                points[0],
                points[np.isfinite(points).all(axis=1)],
                _period(one, parameters, frequency),
            )
        )
    return moving, [*notes, *more]


def _chosen(name: str, here: xr.Dataset, letters: Sequence[str]) -> tuple[list[int], list[str]]:
    """Choose attractors by letter or, without letters, by basin fraction. Return their ids, and notes on those left
    out.
    """
    there = [int(i) for i in here["attractor"].values]
    if not there:
        raise SpecError(f"{name}: no attractor was found at this point; look with magpend analyse attractors.")
    by_letter = {letter(i): i for i in there}
    if wrong := [text for text in letters if text.upper() not in by_letter]:
        raise SpecError(
            [f"--attractor {text}: does not exist at this point; there are: {', '.join(by_letter)}." for text in wrong]
        )
    if letters:
        chosen = list(dict.fromkeys(by_letter[text.upper()] for text in letters))
        if len(chosen) > MOST_MOTIONS:
            raise SpecError(f"--attractor: {len(chosen)} are requested; at most {MOST_MOTIONS} fit a frame.")
        return chosen, []
    attract = here["stability"].values == ATTRACTS
    wanted = attract if attract.any() else ~attract
    by_share = np.argsort(-here["share"].values, kind="stable").tolist()
    ranked = [k for k in by_share if wanted[k]][:MOST_MOTIONS]
    left = {
        "attractors" if attract.any() else "sets": int(wanted.sum()) - len(ranked),
        "sets that do not attract": int((~wanted).sum()),
    }
    more = [f"not shown: {n} of the {what}; choose with --attractor LETTER" for what, n in left.items() if n]
    return sorted(there[k] for k in ranked), more


def _at_point(ds: xr.Dataset, here: xr.Dataset) -> tuple[Parameters, float]:
    values = {str(k): float(v) for k, v in here.coords.items() if not v.ndim and v.dtype.kind == "f"}
    base = parameters_of(ds)
    base = base.replace(**{k: v for k, v in values.items() if k in base})
    return base, frequency_of(base.model, values)


def _period(one: xr.Dataset, parameters: Parameters, frequency: float) -> float:
    kind, periods = int(one["kind"]), int(one["orbit_period"])
    if kind == EQUILIBRIUM:
        return 0.0
    if kind != PERIODIC_ORBIT:
        return math.nan
    seconds = parameters.model.clock.orbit_seconds(periods, frequency)
    return seconds if math.isfinite(seconds) else float(one.get("period_s", math.nan))


def of_cells(run: AnalysedRun, numbers: Sequence[int]) -> list[Moving]:
    """Return cells of a run as motions to animate, from the first section point of each.

    Parameters
    ----------
    run
        The run.
    numbers
        Flat indices of the cells in the cube, with the last dim fastest.

    Raises
    ------
    SpecError
        If there is no such cell, or it has no sections.
    """
    from pipeline.plots.palette import COLOURS

    _refuse(run)
    cube = run.cube()
    shape, dims = cube["status"].shape, cube["status"].dims
    n = math.prod(shape)
    problems = [
        f"--cell {i}: the run has the cells 0 to {n - 1}, counted through {', '.join(map(str, dims))}."
        for i in numbers
        if not 0 <= i < n
    ]
    if len(numbers) > MOST_MOTIONS:
        problems.append(f"--cell: {len(numbers)} are requested; at most {MOST_MOTIONS} fit a frame.")
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
            problems.append(f"--cell {number}: has no sections to start from ({status.advice}).")
            continue
        parameters, frequency = _at_point(cube, one)
        seconds = parameters.model.clock.orbit_seconds(int(one["orbit_period"]), frequency)
        name = f"cell {number}: {_where(one)}"
        moving.append(Moving(name, colour, parameters, frequency, points[0], points, seconds or math.nan))
    if problems:
        raise SpecError(problems)
    return moving


def _where(one: xr.Dataset) -> str:
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


def _refuse(run: AnalysedRun) -> None:
    if problem := run.spec.motion.refusal("an animation"):
        raise SpecError(f"{run.name}: {problem}")


def of_start(parameters: Parameters, frequency_hz: float, state: Sequence[float], n_transient: int = 0) -> Moving:
    """Return the motion from an initial state, after some periods that are not shown.

    Parameters
    ----------
    parameters
        Parameters of any model.
    frequency_hz
        Drive frequency [Hz]; without a drive, the frequency of the periods that `n_transient` counts.
    state
        State at time 0, the time of a section.
    n_transient
        Periods before the film begins.

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
        raise SpecError(f"--transient {n_transient}: must be at least 0.")
    start = np.asarray(state, dtype=np.float64)
    if n_transient:
        begin = np.array([n_transient / frequency_hz])
        start = trajectory(of_flow(parameters), frequency_hz, start, begin, rtol=FILM_RTOL, atol=FILM_RTOL)[0]
    said = ", ".join(f"{s.name} = {v:.4g}" for s, v in zip(parameters.model.states, start, strict=True))
    return Moving(said, COLOURS[0], parameters, frequency_hz, start, np.empty((0, start.size)))


def point_of_run(run: AnalysedRun, options: AnimationOptions) -> tuple[Parameters, float, list[str]]:
    """Return parameters, drive frequency and notes for the parameter point that the options of an animation choose.

    Raises
    ------
    SpecError
        If several points are left, or the run does not have the point.
    """
    from pipeline.plots.figure import values_of
    from pipeline.results.selection import select_points

    _refuse(run)
    cube = run.cube()
    with refused(run.name):
        at, notes = values_of(run, options)
        part = select_points(cube, at, purpose="an animation shows one parameter point")
    here = part.isel({d: 0 for d in part["status"].dims if d not in start_dims(part["status"].dims)})
    return (*_at_point(cube, here), notes)
