"""Simulate one trajectory as a labelled time series, and write it as CSV or NetCDF."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from magpend_core.defaults import ATOL, RTOL
from magpend_core.engine.system import System
from magpend_core.models import DEFAULT, load_model
from magpend_core.models.model import Model, Quantity, State, by_method
from magpend_core.models.presets import Preset
from pipeline.layout.evaluation import check_states
from pipeline.layout.vocabulary import model_attribute
from pipeline.specification.problems import SpecError, unknown_name, validated
from pipeline.specification.recorded_drive import RecordedDrive, load_drive, model_problems
from pipeline.specification.tables import EXPLICIT, FREQUENCY, RATES, STIFF, Integration

if TYPE_CHECKING:
    import xarray as xr

    from magpend_core.models.model import Parameters


# ---- whether a trajectory has closed ---------------------------------------------------------------

LOOKED_AT = 129
"""Number of last sections of a trajectory that are compared."""


LONGEST: int = Integration.model_fields["max_orbit_period"].default
TOLERANCE: float = Integration.model_fields["closure_tolerance"].default
"""Longest period looked for and largest distance of a closed motion: the defaults of runs."""


class Closing(NamedTuple):
    """How far a trajectory is from a periodic orbit, and how long it would take to close on it."""

    period: int  # drive periods after which the motion comes back closest
    # bound on the distance from the orbit if the motion is closed or closes, else the largest distance of late sections
    # that are `period` apart; in the scales of the states, angles on the circle
    distance: float
    # drive periods until the motion closes if it goes on as it does: 0 if it has closed, infinite if the distance does
    # not shrink
    to_go: float

    @property
    def is_closed(self) -> bool:
        """Whether the trajectory lies within `TOLERANCE` of a periodic orbit."""
        return self.to_go == 0.0

    def sentence(self, n_transient: int) -> str:
        """Return a sentence on whether the trajectory has closed, or which ``--transient`` would suffice."""
        periods = f"{self.period} drive period{'s' if self.period > 1 else ''}"
        if self.is_closed:
            return f"closed: the motion repeats after {periods} (distance {self.distance:.1e})"
        text = f"not closed: after {periods} the motion comes back to a distance of {self.distance:.1e}"
        if math.isinf(self.to_go):
            return f"{text}, which does not shrink steadily (closed: {TOLERANCE:g})"
        enough = n_transient + math.ceil(self.to_go)
        return (
            f"{text}; if this distance goes on shrinking as it does, the motion has closed ({TOLERANCE:g}) "
            f"after --transient {enough}"
        )


def closing_of(sections: np.ndarray, system: System) -> Closing | None:
    """Decide whether a trajectory has closed on a periodic orbit, by comparing its last sections, shape (n, n_states).

    The distances of a period fall into four quarters. If the largest of each quarter shrinks from quarter to quarter,
    the sum of all that follow bounds the distance from the orbit, as in `magpend_core.engine.observers.closed_period`.
    Return None for fewer than 8 sections.
    """
    fewest = 8  # sections for a decision
    n = len(sections)
    if n < fewest:
        return None
    lags = [_lag_distances(sections, p, system) for p in range(1, min(LONGEST, n // 4) + 1)]
    found = [_judged(p, distances) for p, distances in enumerate(lags, 1)]
    closed = [one for one in found if one.is_closed]
    if closed:
        return next(
            one._replace(distance=closed[0].distance, to_go=0.0)
            for one, distances in zip(found, lags, strict=True)
            # see `observers._smallest_divisor`
            if closed[0].period % one.period == 0 and _late(distances) <= 10.0 * TOLERANCE
        )
    # prefer a shrinking distance to a small one; multiples of a period have about the same bound
    least = min(found, key=lambda one: (math.isinf(one.to_go), one.distance))
    return next(
        one
        for one in found
        if one.distance <= 3.0 * least.distance and math.isinf(one.to_go) == math.isinf(least.to_go)
    )


def _lag_distances(sections: np.ndarray, p: int, system: System) -> np.ndarray:
    apart = np.abs(sections[p:] - sections[:-p])
    angles = np.array(system.is_angle, dtype=bool)
    turned = apart[:, angles] % (2.0 * np.pi)
    apart[:, angles] = np.minimum(turned, 2.0 * np.pi - turned)
    return np.asarray((apart / np.array(system.scales)).max(axis=1))


def _late(distances: np.ndarray) -> float:
    return float(distances[-(len(distances) // 4) :].max())


def _judged(p: int, distances: np.ndarray) -> Closing:
    """Decide from the distances between points `p` periods apart whether a trajectory closes with period `p`."""
    near = 0.1  # largest distance from an orbit at which a rate is trusted: chaotic sections also approach by chance
    quarter = len(distances) // 4
    last = distances[len(distances) - 4 * quarter :].reshape(4, quarter).max(axis=1)
    if last[2:].max() <= 0.01 * TOLERANCE:  # errors of integration hide what shrinks
        return Closing(p, float(last[-1]), 0.0)
    rate = math.log(last[1] / last[3]) / (2 * quarter) if last[3] > 0.0 else 0.0
    bound = float(last[-1] / -math.expm1(-rate * p)) if rate > 0.0 else math.inf
    if bound > near or not (np.diff(last) < 0.0).all():
        return Closing(p, float(last[-1]), math.inf)
    return Closing(p, bound, max(0.0, math.log(bound / TOLERANCE) / rate))


# ---- time series -----------------------------------------------------------------------------------

MAX_SAMPLES = 100_000_000
DEGREES = "_deg"
DEFAULT_PERIODS = 10
FLOW_PERIODS = 50
"""Default number of a flow's strobe periods."""


@dataclass(frozen=True)
class Series:
    """Settings of a time series: periods of transient and series, samples per period, tolerances, method."""

    n_transient: int
    n_periods: int | None
    samples_per_period: int
    rtol: float
    atol: float
    method: str


def simulate(
    frequency_hz: float | None,
    initial_state: Sequence[float],
    *,
    drive: str | Path | None = None,
    model: str | Mapping[str, Any] | Model = DEFAULT,
    preset: str | Path | Preset | None = None,
    overrides: Mapping[str, float] | None = None,
    n_transient: int = 0,
    n_periods: int | None = None,
    samples_per_period: int = 200,
    rtol: float = RTOL,
    atol: float = ATOL,
    method: str = EXPLICIT,
) -> xr.Dataset:
    """Integrate one trajectory under the model's own or a recorded drive, and return it as a labelled time series.

    Parameters
    ----------
    frequency_hz
        Drive frequency [Hz]; None under a recorded drive, and without a drive, where periods are seconds.
    initial_state
        The model's states at time 0, or where the recorded drive begins, in their units.
    drive
        A drive file (see `pipeline.specification.recorded_drive`): the drive is a recording.
    model
        A model, or what `magpend_core.load_model` takes for one.
    preset, overrides
        Name or file of a preset and parameters by name, see `magpend_core.models.model.Model.load`. Among these,
        ``omega`` or ``period`` gives the drive's rate instead of `frequency_hz`.
    n_transient
        Drive periods before the series begins.
    n_periods, samples_per_period
        Length and density of the series; both ends are included. By default 10 periods, or all
        that a recorded drive has.
    rtol, atol
        Tolerances.
    method
        ``"dopri5"``, or ``"rodas5p"`` for stiff equations.

    Returns
    -------
    xarray.Dataset
        The states and the model's quantities over ``time`` [s since the first section; by the clock of the
        drive file if there is one]; angles are not wrapped.

    Raises
    ------
    SpecError
        With all that is wrong with the arguments.
    ArithmeticError
        If the trajectory diverges or meets the step limit.
    """
    from magpend_core.models.parameters import ParameterError

    chosen = load_model(model)
    if not chosen.clock.is_continuous:
        raise SpecError(f"{chosen.name} is a map, without motion between its iterations: run it with magpend run.")
    if drive is None and not chosen.clock.has_drive:
        frequency_hz = chosen.clock.default_hz if frequency_hz is None else frequency_hz
        n_periods = FLOW_PERIODS if n_periods is None else n_periods
    series = Series(n_transient, n_periods, samples_per_period, rtol, atol, method)
    problems = _problems(series) + _state_problems(chosen, initial_state)
    frequency_hz, overrides = with_rate(frequency_hz, overrides or {}, chosen)
    recording = _recording(drive, frequency_hz, chosen, series, problems)
    try:
        found = chosen.preset(preset)
        parameters = by_method(chosen, STIFF if method == STIFF else EXPLICIT).load(found, **overrides)
    except ParameterError as error:
        problems += error.problems
    if problems:
        raise SpecError(problems)
    state = np.array(initial_state, dtype=np.float64)
    check_states(chosen, state[None], [{**parameters, FREQUENCY: frequency_hz}])
    if recording is None:
        assert frequency_hz is not None
        ds = _at_frequency(parameters, frequency_hz, state, series)
    else:
        ds = _under_recording(parameters, recording, state, series)
    origin = {**found.provenance, **dict.fromkeys(overrides, "given")}
    sources = "\n".join(f"{name}: {origin.get(name, '')}" for name in parameters)
    return ds.assign_attrs(
        preset=found.name, sources=sources, initial_state=state, n_transient=n_transient, rtol=rtol, atol=atol
    )


def with_rate(
    frequency_hz: float | None, overrides: Mapping[str, float], model: Model
) -> tuple[float | None, dict[str, float]]:
    """Take the drive's rate, in any of its words, out of parameters by name; return it in Hz, and the others."""
    words = [word for word in RATES if word in overrides and word not in model.parameter_names]
    for word in words:
        frequency_hz = RATES[word].hertz(overrides[word])
    return frequency_hz, {name: value for name, value in overrides.items() if name not in words}


def _recording(
    drive: str | Path | None, frequency_hz: float | None, model: Model, series: Series, problems: list[str]
) -> RecordedDrive | None:
    """Read the recorded drive, if one is given. Problems with it, or with the frequency, are appended to `problems`."""
    if drive is None:
        if frequency_hz is None or not (math.isfinite(frequency_hz) and frequency_hz > 0):
            problems.append(f"frequency_hz = {frequency_hz!r}: must be a finite number greater than 0.")
        return None
    if frequency_hz is not None:
        problems.append(
            f"frequency_hz = {frequency_hz!r}: the recorded drive {drive} has its own; drop one of the two."
        )
    try:
        found = load_drive(drive)
    except SpecError as error:
        problems += error.problems
        return None
    problems += model_problems(found, model)
    wanted = series.n_transient + (series.n_periods or 1)
    if wanted > found.n_periods and (series.n_transient or series.n_periods):
        problems.append(
            f"n_transient = {series.n_transient} and n_periods = {series.n_periods or 1} are {wanted} drive "
            f"periods, and {found.file} has {found.n_periods}; lower them, or record longer."
        )
    return found


def _at_frequency(parameters: Parameters, frequency_hz: float, state: np.ndarray, series: Series) -> xr.Dataset:
    from magpend_core import evaluate, trajectory

    n, samples = series.n_periods or DEFAULT_PERIODS, series.samples_per_period
    time = (series.n_transient + np.arange(n * samples + 1) / samples) / frequency_hz
    # sections before the series, to compare with; asking for them changes no step
    first = min(series.n_transient, max(0, series.n_transient + n + 1 - LOOKED_AT))
    before = np.arange(first, series.n_transient) / frequency_hz
    asked = np.append(before, time)
    states = trajectory(parameters, frequency_hz, state, asked, rtol=series.rtol, atol=series.atol)
    sections = np.vstack([states[: len(before)], states[len(before) :: samples]])
    states = states[len(before) :]
    names = [q.name for q in parameters.model.quantities]
    values = evaluate(names, time, states, parameters, frequency_hz)
    ds = labelled(parameters, time, f"time since {parameters.model.section}", states, values)
    if not parameters.model.clock.has_drive:  # no period to close on
        return ds
    return ds.assign_attrs(frequency_hz=float(frequency_hz), **_closing(sections, parameters, series))


def _closing(sections: np.ndarray, parameters: Parameters, series: Series) -> dict[str, Any]:
    """Return dataset attributes that say whether the trajectory has closed on a periodic orbit."""
    found = closing_of(sections[-LOOKED_AT:], parameters.model.system)
    if found is None:
        return {}
    return {"orbit_period": found.period if found.is_closed else 0, "closing": found.sentence(series.n_transient)}


def _under_recording(parameters: Parameters, drive: RecordedDrive, state: np.ndarray, series: Series) -> xr.Dataset:
    from magpend_core.recorded_drive import evaluate_recorded, recorded_trajectory

    marks = np.append(drive.start_s, drive.sections_s)
    begin = float(marks[series.n_transient])
    end = drive.end_s if series.n_periods is None else float(marks[series.n_transient + series.n_periods])
    n = max(1, round((end - begin) * drive.frequency_hz * series.samples_per_period))
    since = np.minimum(np.linspace(begin, end, n + 1) - drive.start_s, drive.end_s - drive.start_s)
    states = recorded_trajectory(parameters, drive.intervals, state, since, rtol=series.rtol, atol=series.atol)
    names = [q.name for q in parameters.model.quantities]
    values = evaluate_recorded(names, since, states, parameters, drive.intervals)
    ds = labelled(parameters, since + drive.start_s, f"time by the clock of {drive.file}", states, values)
    inside = marks[(marks >= begin) & (marks <= end)]
    attrs = {"units": "s", "long_name": "instants of the sections"}
    return ds.assign_coords(section_times=("section", inside, attrs)).assign_attrs(
        frequency_hz=drive.frequency_hz, drive=drive.kind, drive_file=drive.file, drive_sha256=drive.sha256
    )


def labelled(
    parameters: Parameters, time: np.ndarray, clock: str, states: np.ndarray, values: np.ndarray
) -> xr.Dataset:
    """Build the dataset of a time series: states and quantities with their names and units, and the parameters."""
    import xarray as xr

    model = parameters.model
    both: tuple[State | Quantity, ...] = (*model.states, *model.quantities)
    variables: dict[str, Any] = {
        v.name: ("time", column, {"units": v.unit, "long_name": v.meaning})
        for v, column in zip(both, np.hstack([states, values]).T, strict=True)
    }
    attrs = {
        "title": f"trajectory of the {model.title}",
        "model": model_attribute(model),
        "parameters": "\n".join(f"{name} = {value!r}" for name, value in parameters.as_dict().items()),
    }
    axis = ("time", time, {"units": "s", "long_name": clock})
    return xr.Dataset(variables, coords={"time": axis}, attrs=attrs)


def start_of(model: str | Model, given: Mapping[str, float]) -> tuple[float, ...]:
    """Return the initial state of a model from values by name; names ending in ``_deg`` take degrees, the other states
    are 0.

    Raise `SpecError` if a name is unknown, or a state is given twice.
    """
    found = load_model(model)
    in_degrees = [f"{s.name}{DEGREES}" for s in found.states if s.unit.startswith("rad")]
    problems, values = [], dict.fromkeys(found.state_names, 0.0)
    for name, value in given.items():
        plain = name.removesuffix(DEGREES) if name in in_degrees else name
        if plain not in values:
            problems.append(unknown_name(f"state of {found.name}", name, (*found.state_names, *in_degrees)))
        elif plain != name and plain in given:
            problems.append(f"{plain} and {name} are both given; keep one.")
        else:
            values[plain] = math.radians(value) if plain != name else value
    if problems:
        raise SpecError(problems)
    return tuple(values.values())


def _state_problems(model: Model, state: Sequence[float]) -> list[str]:
    names = model.state_names
    if len(state) != len(names):
        return [f"initial_state has {len(state)} numbers: {model.name} has the states {', '.join(names)}."]
    return [
        f"{name} = {value!r}: must be a finite number."
        for name, value in zip(names, state, strict=True)
        if not math.isfinite(value)
    ]


def _problems(series: Series) -> list[str]:
    found: list[str] = []
    if series.method not in (EXPLICIT, STIFF):
        found.append(f"method = {series.method!r}: must be {EXPLICIT} or {STIFF}, which give states between steps.")
    try:
        # what a specification has too has its bounds there
        validated(Integration, {"rtol": series.rtol, "atol": series.atol, "n_transient": series.n_transient})
    except SpecError as error:
        found += error.problems
    n_periods = DEFAULT_PERIODS if series.n_periods is None else series.n_periods
    for name, number in {"n_periods": n_periods, "samples_per_period": series.samples_per_period}.items():
        if number < 1:
            found.append(f"{name} = {number!r}: must be at least 1.")
    samples = n_periods * series.samples_per_period
    if samples > MAX_SAMPLES:
        found.append(f"n_periods * samples_per_period = {samples}: must be at most {MAX_SAMPLES}.")
    return found


def series_csv(ds: xr.Dataset) -> str:
    """Return a time series as CSV text, with the units in the names of the columns."""
    names = ["time", *map(str, ds.data_vars)]
    units = [re.sub(r"\W+", "_", ds[name].attrs["units"].replace("/", "_per_")) for name in names]
    table = np.column_stack([ds[name].values for name in names])
    header = ",".join(f"{name}_{unit}" for name, unit in zip(names, units, strict=True))
    text = io.StringIO()
    np.savetxt(text, table, delimiter=",", header=header, comments="", fmt="%.17g")
    return text.getvalue()
