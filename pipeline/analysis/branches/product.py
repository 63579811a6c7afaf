"""Branches of periodic orbits as a product of a run (see `pipeline.products.derived`)."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from pipeline.products.derived import Echo, Snapshot, Source, attractors, derive
from pipeline.spec.problems import SpecError

if TYPE_CHECKING:
    import xarray as xr


def branches(
    directory: Source,
    *,
    parameter: str = "frequency_hz",
    low: float | None = None,
    high: float | None = None,
    max_period: int = 4,
    generations: int = 3,
    recurrences: int = 0,
    echo: Echo | None = None,
) -> xr.Dataset:
    """Branches of periodic orbits along a parameter, from the orbits that attract a run's cells.

    Parameters
    ----------
    directory
        Run directory, or a `Snapshot`.
    parameter
        ``frequency_hz`` or a parameter's name.
    low, high
        Interval of the parameter [SI]; by default what the run spans.
    max_period
        Longest period of a branch [drive periods].
    generations
        How often branches that spring from branches are followed.
    recurrences
        Longest period of the orbits looked for near close recurrences of bounded cells; 0 looks for none.
    echo
        Prints a line.

    Returns
    -------
    Dataset
        As `pipeline.analysis.branches` says.

    Raises
    ------
    SpecError
        If an option is out of bounds.
    ParameterError
        If an end of the interval is.
    """
    snapshot = Snapshot.of(directory)
    interval = _interval(snapshot, parameter, low, high)
    problems = [
        f"{name} = {value}: must be {least} or more."
        for name, value, least in (
            ("max_period", max_period, 1),
            ("generations", generations, 0),
            ("recurrences", recurrences, 0),
        )
        if value < least
    ]
    if problems:
        raise SpecError(problems)
    options: dict[str, Any] = {
        "parameter": parameter, "low": interval[0], "high": interval[1], "max_period": max_period,
        "generations": generations, "recurrences": recurrences,
    }  # fmt: skip
    return derive(snapshot, "branches", options, lambda s: _branches(s, echo, **options), echo)


def _interval(
    snapshot: Snapshot, parameter: str, low: float | None, high: float | None
) -> tuple[float, float]:
    """Check the parameter and complete its interval from the run's axis."""
    from magpend_core.models.parameters import unknown_name_problem
    from pipeline.analysis.attractors.attractors import parameters_of

    ds = snapshot.open()
    names = (*parameters_of(ds).names, "frequency_hz")
    if parameter not in names:
        raise SpecError([unknown_name_problem(parameter, names)])
    axis = ds.coords.get("frequency" if parameter == "frequency_hz" else parameter)
    if axis is not None and axis.ndim > 0 and axis.size > 1:
        ends = float(axis.min()), float(axis.max())
    elif low is None or high is None:
        raise SpecError([f"the run does not sweep {parameter}; give the interval with --from and --to."])
    else:
        ends = low, high
    chosen = (ends[0] if low is None else float(low), ends[1] if high is None else float(high))
    if not chosen[0] < chosen[1]:
        raise SpecError(
            [
                f"the interval {chosen[0]} to {chosen[1]} of {parameter} is empty; "
                "--from must be less than --to."
            ]
        )
    if parameter == "frequency_hz" and chosen[0] <= 0.0:
        raise SpecError([f"--from {chosen[0]}: a drive frequency must be greater than 0."])
    for value in chosen if parameter != "frequency_hz" else ():
        parameters_of(ds).replace(**{parameter: value})
    return chosen


def _branches(
    snapshot: Snapshot,
    echo: Echo | None,
    parameter: str,
    low: float,
    high: float,
    max_period: int,
    generations: int,
    recurrences: int,
) -> xr.Dataset:
    from pipeline.analysis.attractors.attractors import parameters_of
    from pipeline.analysis.branches import Scope, attracting, dataset_of, explore, recurrent

    cube = snapshot.open()
    base, scale = parameters_of(cube), high - low
    found = attractors(snapshot, echo=echo)
    starts = attracting(found, base, parameter, scale, max_period)
    if recurrences:
        starts += recurrent(cube, base, parameter, scale, min(recurrences, max_period))
    starts = [s for s in starts if low <= s.value <= high]
    if echo is not None:
        echo(f"branches: {len(starts)} starting orbits")
    return dataset_of(explore(starts, Scope(low, high, max_period, generations)), parameter, base)


def curves(
    directory: Source,
    second: str,
    second_low: float,
    second_high: float,
    *,
    curve_period: int = 1,
    echo: Echo | None = None,
    **options: Any,
) -> xr.Dataset:
    """Curves of the bifurcations located by `branches`, in the plane of its parameter and a second one.

    Parameters
    ----------
    directory
        Run directory, or a `Snapshot`.
    second
        ``frequency_hz`` or a parameter's name.
    second_low, second_high
        Interval of the second parameter [SI].
    curve_period
        Longest period of the orbits taken [drive periods].
    echo
        Prints a line.
    options
        Those of `branches`.

    Returns
    -------
    Dataset
        As `pipeline.analysis.branches.curves_dataset` says.

    Raises
    ------
    SpecError
        If an option is out of bounds, or the run sweeps the second parameter.
    """
    snapshot = Snapshot.of(directory)
    located = branches(snapshot, echo=echo, **options)
    first = str(located.attrs["parameter"])
    if second == first:
        raise SpecError([f"{second} is the branches' own parameter; give another one."])
    axis = snapshot.open().coords.get("frequency" if second == "frequency_hz" else second)
    if axis is not None and axis.ndim > 0 and axis.size > 1:
        raise SpecError(
            [f"the run sweeps {second}, so that its branches lie at several values; use a run that does not."]
        )
    interval = _interval(snapshot, second, second_low, second_high)
    if curve_period < 1:
        raise SpecError([f"curve_period = {curve_period}: must be 1 or more."])
    wanted = {
        **json.loads(located.attrs["derived_options"]),
        "second": second,
        "second_low": interval[0],
        "second_high": interval[1],
        "curve_period": curve_period,
    }

    def compute(at: Snapshot) -> xr.Dataset:
        from pipeline.analysis.attractors.attractors import parameters_of
        from pipeline.analysis.branches import curves_dataset, curves_from

        base = parameters_of(at.open())
        bounds = ((wanted["low"], wanted["high"]), interval)
        return curves_dataset(curves_from(located, base, second, bounds, curve_period), first, second)

    return derive(snapshot, "curves", wanted, compute, echo)
