"""Find the interval in which the branches of a run lie."""

from __future__ import annotations

from typing import TypeVar

import xarray as xr

from pipeline.analysis.branches.declaration import AlongOptions, BranchOptions
from pipeline.layout.own_words import axis_in_own_words
from pipeline.layout.vocabulary import FREQUENCY_DIM, axis_name, parameters_of
from pipeline.results.run import OpenRun
from pipeline.specification.problems import SpecError, unknown_name

Along = TypeVar("Along", bound=AlongOptions)


def settle_along(run: OpenRun, options: Along) -> Along:
    """Return options of an analysis that rests on the run's branches; raise SpecError if there can be none."""
    refuse_frequency_of_flow(run, options.parameter)
    interval_along(run, options.parameter)
    return options


def interval_along(run: OpenRun, parameter: str) -> tuple[float, float]:
    """Return the interval of the run's branches along a parameter; raise SpecError if there can be none."""
    options: BranchOptions = run.branch_options(parameter)
    return interval_of(run, parameter, options.low, options.high)


def refuse_frequency_of_flow(run: OpenRun, parameter: str) -> None:
    """Raise SpecError if branches are to follow the drive frequency, but the model has no drive."""
    if axis_name(parameter) == FREQUENCY_DIM and run.model.clock.hertz is not None:
        swept = [name for name in run.spec.axes if swept_axis(run, name) is not None]
        known = ", ".join(swept or run.model.parameter_names)
        raise SpecError(f"{run.model.name} has no drive frequency to follow; give --parameter: {known}.")


def swept_axis(run: OpenRun, parameter: str) -> xr.DataArray | None:
    """Return the axis of a parameter in the run's result cube; None if the run does not sweep it."""
    axis = run.cube().coords.get(axis_name(parameter))
    return axis if axis is not None and axis.ndim > 0 and axis.size > 1 else None


def interval_of(run: OpenRun, parameter: str, low: float | None, high: float | None) -> tuple[float, float]:
    """Return the parameter interval of the branches; its default is the range that the run sweeps."""
    base = parameters_of(run.cube())
    is_frequency = axis_name(parameter) == FREQUENCY_DIM
    if not is_frequency and parameter not in base.names:
        raise SpecError(unknown_name("parameter", parameter, (*base.names, run.spec.rate)))
    axis = swept_axis(run, parameter)
    if axis is not None:
        ends = float(axis.min()), float(axis.max())
    elif low is None or high is None:
        told = f"the run does not sweep {in_words(run, parameter)}"
        raise SpecError(f"{told}; give the interval with --from and --to (of analyse branches).")
    else:
        ends = low, high
    chosen = (ends[0] if low is None else float(low), ends[1] if high is None else float(high))
    if is_frequency and min(chosen) <= 0.0:
        least = axis_in_own_words(parameter, run.spec.rate)[1](min(chosen))
        raise SpecError(f"--from, --to: {in_words(run, parameter)} = {least:g} must be greater than 0.")
    if not chosen[0] < chosen[1]:
        name, given = axis_in_own_words(parameter, run.spec.rate)
        first, last = sorted(map(float, map(given, chosen)), reverse=True)
        raise SpecError(f"the interval {first:g} to {last:g} of {name} is empty; --from must be less than --to.")
    for value in () if is_frequency else chosen:
        base.replace(**{parameter: value})
    return chosen


def in_words(run: OpenRun, parameter: str) -> str:
    """Return the name of a parameter in the run's specification."""
    return axis_in_own_words(parameter, run.spec.rate)[0]
