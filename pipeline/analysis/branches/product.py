"""Define the analyses ``branches`` (of orbits) and ``curves`` (of bifurcations) of a run."""

from __future__ import annotations

import xarray as xr

from pipeline.analysis.run import OpenRun
from pipeline.layout.vocabulary import FREQUENCY_DIM, axis_name, parameters_of
from pipeline.products.branches import BranchOptions, CurveOptions

LEAST_PERIOD = 4
"""Least limit for the periods of followed branches, however short the orbits of the run are."""


def settle_branches(run: OpenRun, options: BranchOptions) -> BranchOptions:
    """Fill in the parameter interval of the branches from the run's swept axis; raise SpecError if it is empty."""
    parameter = options.parameter
    _refuse_frequency_of_flow(run, parameter)
    low, high = interval_of(run, parameter, options.low, options.high)
    return options.model_copy(update={"parameter": parameter, "low": low, "high": high})


def _refuse_frequency_of_flow(run: OpenRun, parameter: str) -> None:
    """Raise SpecError if branches are to follow the drive frequency, but the model has no drive."""
    from pipeline.specification.problems import SpecError

    if axis_name(parameter) == FREQUENCY_DIM and run.model.crossing is not None:
        swept = [name for name in run.spec.axes if swept_axis(run, name) is not None]
        known = ", ".join(swept or run.model.parameter_names)
        raise SpecError(f"{run.model.name} has no drive frequency to follow; give --parameter: {known}.")


def branches(run: OpenRun, options: BranchOptions) -> xr.Dataset:
    """Follow branches of periodic orbits along a parameter, from the attractors of a run."""
    from pipeline.analysis.branches import Scope, attracting, dataset_of, explore, recurrent

    cube, parameter = run.cube(), axis_name(options.parameter)
    interval = low, high = _ends(options)
    base = parameters_of(cube)
    starts, left_out = attracting(run.derive("attractors"), base, parameter, interval, options.max_period)
    longest = options.max_period or max([LEAST_PERIOD, *(s.family.period for s in starts)])
    if options.recurrences:
        found = recurrent(cube, base, parameter, high - low, min(options.recurrences, longest))
        starts += [s for s in found if low <= s.value <= high]
    run.echo(f"branches: {len(starts)} starting orbits, periods up to {longest}")
    scope = Scope(low, high, longest, options.generations)
    followed = explore(starts, scope)
    if starts and not followed:
        left_out = [*left_out, f"{len(starts)} starting orbits: could not be followed"]
    return dataset_of(followed, parameter, base, left_out)


def _ends(options: BranchOptions) -> tuple[float, float]:
    assert options.low is not None
    assert options.high is not None
    return options.low, options.high


def settle_curves(run: OpenRun, options: CurveOptions) -> CurveOptions:
    """Fill in the parameter interval of the branches; raise SpecError unless the second parameter differs from the
    first.
    """
    from pipeline.specification.problems import SpecError

    settled = options.model_copy(update=settle_branches(run, options).part(BranchOptions))
    second = options.second
    if axis_name(second) == axis_name(settled.parameter):
        raise SpecError(f"{second} is the branches' own parameter; give another one.")
    if swept_axis(run, second) is not None:
        raise SpecError(
            f"the run sweeps {second}, so that its branches lie at several values; use a run that does not."
        )
    interval_of(run, second, options.second_low, options.second_high)
    return settled


def curves(run: OpenRun, options: CurveOptions) -> xr.Dataset:
    """Continue the bifurcations on the branches in the plane of the branches' parameter and a second one."""
    from pipeline.analysis.branches import curves_dataset, curves_from

    located = run.derive("branches", **options.part(BranchOptions))
    bounds = (_ends(options), (options.second_low, options.second_high))
    second = axis_name(options.second)
    base = parameters_of(run.cube())
    found = curves_from(located, base, second, bounds, options.curve_period)
    return curves_dataset(found, axis_name(options.parameter), second, base.model)


def swept_axis(run: OpenRun, parameter: str) -> xr.DataArray | None:
    """Return the axis of a parameter in the run's result cube; None if the run does not sweep it."""
    axis = run.cube().coords.get(axis_name(parameter))
    return axis if axis is not None and axis.ndim > 0 and axis.size > 1 else None


def interval_of(run: OpenRun, parameter: str, low: float | None, high: float | None) -> tuple[float, float]:
    """Return the parameter interval of the branches; its default is the range that the run sweeps."""
    from pipeline.specification.problems import SpecError, unknown_name

    base = parameters_of(run.cube())
    is_frequency = axis_name(parameter) == FREQUENCY_DIM
    if not is_frequency and parameter not in base.names:
        raise SpecError(unknown_name("parameter", parameter, (*base.names, FREQUENCY_DIM)))
    axis = swept_axis(run, parameter)
    if axis is not None:
        ends = float(axis.min()), float(axis.max())
    elif low is None or high is None:
        raise SpecError(f"the run does not sweep {parameter}; give the interval with --from and --to.")
    else:
        ends = low, high
    chosen = (ends[0] if low is None else float(low), ends[1] if high is None else float(high))
    if not chosen[0] < chosen[1]:
        raise SpecError(
            f"the interval {chosen[0]} to {chosen[1]} of {parameter} is empty; --from must be less than --to."
        )
    if is_frequency and chosen[0] <= 0.0:
        raise SpecError(f"--from {chosen[0]}: a drive frequency must be greater than 0.")
    for value in () if is_frequency else chosen:
        base.replace(**{parameter: value})
    return chosen
