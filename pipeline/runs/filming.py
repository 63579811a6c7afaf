"""Make an animation of motions, from a run or from an initial state, as ``magpend animate`` does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magpend_core.models import DEFAULT, load_model
from magpend_core.models.model import Model
from magpend_core.models.presets import Preset
from pipeline.products.animation import AnimationOptions
from pipeline.runs import instants, moving
from pipeline.runs.derive import AnalysedRun, Echo, Source
from pipeline.runs.naming import named
from pipeline.specification.problems import SpecError, validated

if TYPE_CHECKING:
    from pipeline.plots.animation import Animation

CLOCK_HZ, DEFAULT_HZ = 1.0, 2.2
"""Frequency of a start's periods for a model without a drive, and default drive frequency."""


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
        Options of `pipeline.products.animation.AnimationOptions` that differ from the defaults.
    attractors
        Letters of attractors of the run. By default, without `cells` and `start`, all attractors at the
        parameter point.
    cells
        Indices of cells of the run, see `pipeline.runs.moving.of_cells`.
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
        (echo or _silent)(line)
    data = with_provenance(instants.filmed(shown, plan).assign_attrs(fps=wanted.fps), told)
    return plot_animation(data, degrees=wanted.degrees, portrait=wanted.portrait, size=wanted.size)


def _silent(_: str) -> None:
    pass


def _of_run(
    run: AnalysedRun, options: AnimationOptions, attractors: Sequence[str], cells: Sequence[int], start: Start | None
) -> tuple[list[instants.Moving], list[str]]:
    from pipeline.compute.simulate import start_of

    if cells:
        return moving.of_cells(run, cells), []
    if start is None:
        return moving.of_attractors(run, options, attractors)
    parameters, frequency, notes = moving.point_of_run(run, options)
    state = start_of(run.model.flow, start.state)
    return [moving.of_start(parameters, frequency, state, start.transient)], notes


def _alone(start: Start) -> instants.Moving:
    """Integrate a model from an initial state as a motion to animate, without a run."""
    import numpy as np

    from pipeline.compute.simulate import start_of
    from pipeline.layout.domains import check_states
    from pipeline.specification.tables import FREQUENCY

    model = load_model(start.model)
    frequency = start.frequency_hz
    if frequency is None:
        frequency = CLOCK_HZ if model.autonomous else DEFAULT_HZ
    state = start_of(model, start.state)
    parameters = model.load(start.preset, **start.overrides)
    check_states(model, np.array([state]), [{**parameters, FREQUENCY: frequency}])
    return moving.of_start(parameters, frequency, state, start.transient)
