"""Define the tables ``[drift.NAME]`` of a specification: parameters that move while a run integrates.

The numbers of a ramp are parameters of the run, called ``NAME_KEY``, such as ``q_rate_per_s``; so each of them
can be an axis.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import ConfigDict, Field

from magpend_core.models.drift.model import drifting
from magpend_core.models.drift.ramps import NUMBERS, TABLE, Ramp, RampOfCells, motions_of
from magpend_core.models.parameters import unknown_name_problem
from pipeline.specification.files import has_digest
from pipeline.specification.problems import SpecError, checked, shown
from pipeline.specification.tables import FREQUENCY, Range, Table

if TYPE_CHECKING:
    from magpend_core.models.model import Model, Parameters

HEADER = ("time_s", "value")
MOST_CORNERS = 64
PAIRS = (
    *(("rate_per_s", "rate_per_period"), ("start_s", "start_periods")),
    *(("duration_s", "duration_periods"), ("hold_s", "hold_periods")),
)
_OF_A_FILE = ("start_s", "start_periods")


class DriftTable(Table):
    """A table ``[drift.NAME]``: the motion of one parameter, a ramp or a recorded function of time."""

    model_config = ConfigDict(populate_by_name=True)

    from_: float | None = Field(None, alias="from", description="Value before the ramp; by default the parameter's.")
    to: float | None = Field(None, description="Value after the ramp. Give two of to, a rate and a duration.")
    rate_per_s: float | None = Field(None, description="Mean change per second on the ramp.")
    rate_per_period: float | None = Field(None, description="Mean change per drive period, instead of rate_per_s.")
    start_s: float | None = Field(None, ge=0, description="Start of the ramp or of the file's time [s]; by default 0.")
    start_periods: float | None = Field(None, ge=0, description="Start in drive periods, instead of start_s.")
    duration_s: float | None = Field(None, gt=0, description="Duration of the ramp [s].")
    duration_periods: float | None = Field(None, gt=0, description="Duration in drive periods, instead of duration_s.")
    hold_s: float | None = Field(None, ge=0, description="Time at `to` before the way back [s]; without it none.")
    hold_periods: float | None = Field(None, ge=0, description="The same in drive periods, instead of hold_s.")
    shape: Literal["linear", "tanh"] = Field(
        "linear", description="linear, or tanh: smooth, five times as steep in the middle as on average."
    )
    file: str | None = Field(
        None, min_length=1, description="Instead of a ramp: CSV file with the columns time_s,value, joined by lines."
    )
    sha256: str | None = Field(None, description="Digest of the file; filled in when the file is read.")
    text: str | None = Field(None, description="The file's text; filled in when the file is read.")

    def number(self, key: str) -> float | None:
        """Return the number with a key of the table."""
        found: float | None = getattr(self, "from_" if key == "from" else key)
        return found

    def plain(self) -> dict[str, Any]:
        """Return the table as plain data with the keys of the file."""
        return self.model_dump(mode="json", exclude_none=True, by_alias=True)


def drift_tables(data: Mapping[str, Any], problems: list[str]) -> dict[str, DriftTable]:
    """Return the valid tables of ``[drift]`` by parameter; add the problems of the others to `problems`."""
    found = {}
    for name, table in data.get("drift", {}).items():
        if not isinstance(table, dict):
            problems.append(f"drift.{name} = {shown(table)}: must be a table; write [drift.{name}].")
        elif (valid := checked(DriftTable, table, f"drift.{name}", problems)) is not None:
            found[name] = valid
    return found


def ramps_of(tables: Mapping[str, DriftTable], axes: Mapping[str, Range]) -> tuple[Ramp, ...]:
    """Return the ramps of valid tables; numbers that are axes have the first value of the axis."""
    return tuple(_ramp(name, table, axes, []) for name, table in tables.items())


def checked_ramps(
    tables: Mapping[str, DriftTable], model: Model, axes: Mapping[str, Range], problems: list[str]
) -> tuple[Ramp, ...]:
    """Return the ramps of the tables that fit a model; add the problems of the others to `problems`."""
    found = []
    for name, table in tables.items():
        own: list[str] = []
        if name == FREQUENCY:
            own.append(
                f"drift.{name}: the drive's frequency cannot move, since sections lie a drive period apart; move "
                "another parameter, or give the drive as a recording ([drive])."
            )
        elif name not in model.parameter_names:
            own.append(f"drift.{name}: {unknown_name_problem(name, model.parameter_names)}")
        else:
            ramp = _ramp(name, table, axes, own)
            if name in axes and "from" in ramp.keys:
                own.append(f"axes.{name}: drift.{name}.from is where {name} begins; keep one of the two.")
            found += [ramp] if not own else []
        problems += own
    return tuple(found)


def _ramp(name: str, table: DriftTable, axes: Mapping[str, Range], problems: list[str]) -> Ramp:
    """Return the ramp of a table; add its problems to `problems`."""
    numbers: dict[str, float] = {}
    for key in NUMBERS:
        given, axis = table.number(key), axes.get(f"{name}_{key}")
        if given is not None and axis is not None:
            problems.append(f"axes.{name}_{key}: is also drift.{name}.{key}; keep one of the two.")
        if axis is not None:
            numbers[key] = float(axis.array()[0])
        elif given is not None:
            numbers[key] = given
    for one, other in PAIRS:
        if one in numbers and other in numbers:
            problems.append(f"drift.{name}: {one} and {other} are both given; keep one of the two.")
    if table.file is not None:
        return _of_file(name, table, numbers, problems)
    has = {
        "to": "to" in numbers,
        "a rate": "rate_per_s" in numbers or "rate_per_period" in numbers,
        "a duration": "duration_s" in numbers or "duration_periods" in numbers,
    }
    if sum(has.values()) != 2:
        here = ", ".join(word for word, is_there in has.items() if is_there) or "none"
        problems.append(
            f"drift.{name}: give two of to, a rate (rate_per_s, rate_per_period) and a duration (duration_s, "
            f"duration_periods), as keys or axes ({name}_rate_per_s, ...); given: {here}."
        )
    return Ramp(name, table.shape, tuple(numbers.items()))


def _of_file(name: str, table: DriftTable, numbers: Mapping[str, float], problems: list[str]) -> Ramp:
    """Return the motion that a table's file records."""
    more = [key for key in numbers if key not in _OF_A_FILE]
    if more or table.shape != "linear":
        problems.append(f"drift.{name}: {', '.join(more) or 'shape'} belongs to a ramp, not to a file; drop it.")
    times: tuple[float, ...] = (0.0, 1.0)
    values: tuple[float, ...] = (0.0, 0.0)
    if table.text is not None:  # an unreadable file is reported already
        has_digest(table.text, table.sha256, table.file, f"drift.{name}", problems)
        try:
            times, values = read_table(table.text, Path(str(table.file)).name)
        except SpecError as error:
            problems += error.problems
    return Ramp(name, TABLE, tuple((k, v) for k, v in numbers.items() if k in _OF_A_FILE), times, values)


def read_table(text: str, file: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Parse a file with a parameter's values over time; return times since the first one [s], and values.

    Raises
    ------
    SpecError
        If the header or a line is wrong, or times do not rise.
    """
    lines = [(i, line.strip().lstrip("\ufeff")) for i, line in enumerate(text.splitlines(), 1)]
    lines = [(i, line) for i, line in lines if line and not line.startswith("#")]
    if not lines or tuple(word.strip() for word in lines[0][1].split(",")) != HEADER:
        raise SpecError(f"{file}: must begin with the line {','.join(HEADER)!r}.")
    rows = []
    for i, line in lines[1:]:
        try:
            time, value = map(float, line.split(","))
        except ValueError:
            raise SpecError(f"{file}, line {i}: {line[:60]!r} is not two numbers; correct it.") from None
        if not (math.isfinite(time) and math.isfinite(value)):
            raise SpecError(f"{file}, line {i}: {line[:60]!r} is not finite; correct it.")
        rows.append((time, value))
    if len(rows) < 2:
        raise SpecError(f"{file}: has {len(rows)} rows; give two at least.")
    table = np.array(rows)
    steps = np.flatnonzero(np.diff(table[:, 0]) <= 0)
    if len(steps):
        at = int(steps[0])
        raise SpecError(
            [f"{file}: time_s = {table[at + 1, 0]:.9g} s follows {table[at, 0]:.9g} s; time must rise: sort it."]
        )
    return tuple((table[:, 0] - table[0, 0]).tolist()), tuple(table[:, 1].tolist())


def moved(model: Model, ramps: Sequence[Ramp], problems: list[str]) -> Model:
    """Return a model with its moving parameters; the model itself if none moves, or if there are problems."""
    if not ramps:
        return model
    try:
        return drifting(model, tuple(ramps))
    except ValueError as error:
        problems.append(f"drift: {error}")
        return model


def corners_of(
    values: Parameters, axes: Mapping[str, Range], frequency_hz: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return packed parameters and frequencies of cells at the ends of all axes, at most `MOST_CORNERS`."""
    ends = {name: sorted({float(axis.array().min()), float(axis.array().max())}) for name, axis in axes.items()}
    packed, frequency = [], []
    for corner in itertools.islice(itertools.product(*ends.values()), MOST_CORNERS):
        own = dict(zip(ends, corner, strict=True))
        frequency.append(own.pop(FREQUENCY, frequency_hz or 1.0))
        packed.append([{**values, **own}[name] for name in values.names])
    return np.array(packed, np.float64), np.array(frequency, np.float64)


def motion_problems(
    ramps: Sequence[Ramp], values: Parameters, axes: Mapping[str, Range], hz: float | None
) -> list[str]:
    """Return the problems of ramps with their numbers: durations, bounds of the parameters, relations between them."""
    packed, frequency = corners_of(values, axes, hz)
    motions = motions_of(ramps, values.names, packed, frequency)
    return list(dict.fromkeys(p for motion in motions for p in _problems_of_motion(motion, values)))


def _problems_of_motion(motion: RampOfCells, values: Parameters) -> Iterator[str]:
    name = motion.ramp.parameter
    ends = np.concatenate([motion.begin, motion.end, np.asarray(motion.ramp.values, np.float64)])
    bad = ~(np.isfinite(motion.duration_s) & (motion.duration_s > 0))
    if bad.any():
        at = int(np.flatnonzero(bad)[0])
        yield (
            f"drift.{name}: from {motion.begin[at]:g} to {motion.end[at]:g} the ramp would take "
            f"{motion.duration_s[at]:g} s; the rate must lead from the first to the second in a time above 0."
        )
        return
    if (motion.start_s < 0).any():
        yield f"drift.{name}: the ramp starts at {motion.start_s.min():g} s; it must start at 0 or later."
    if motion.hold_s is not None and (motion.hold_s < 0).any():
        yield f"drift.{name}: the way back begins {motion.hold_s.min():g} s after the ramp's end; give 0 or more."
    parameter = values.model.parameter(name)
    for value in dict.fromkeys((float(ends.min()), float(ends.max()))):
        problem = parameter.problem(value)
        if problem is None:
            yield from (f"drift.{name}: {p}" for p in values.model.relations({**values, name: value}))
        else:
            yield f"drift.{name}: {problem}"


def run_problems(tables: Mapping[str, DriftTable], data: Mapping[str, Any], integration: Any, starts: Any) -> list[str]:
    """Return the problems of a specification whose parameters move, beside those of the ramps."""
    if not tables:
        return []
    problems = []
    if data.get("kind") == "continuation":
        problems.append(
            "drift: a continuation starts each value from the last state of the one before, and a ramp would begin "
            'anew there; set kind = "sweep", or drop [drift].'
        )
    if "drive" in data:
        problems.append("drive: parameters cannot move under a recorded drive; drop [drive] or [drift].")
    if "section" in data:
        problems.append(
            "section: parameters move in time, and the time of a crossing is not known; set parameters.frequency_hz, "
            "for sections at even times, and drop [section]."
        )
    if integration is not None and integration.stop_when_closed:
        problems.append("integration.stop_when_closed: an orbit cannot close while parameters move; drop the key.")
    if getattr(starts, "refine", None) is not None:
        problems.append(
            "initial_conditions.refine: cells are inferred from closed orbits, and none closes while parameters "
            "move; drop the key, or [drift]."
        )
    for name in ("lyapunov", "rotation"):
        if name in data.get("products", {}):
            problems.append(
                f"products.{name}: is measured on an attractor at constant parameters; drop the product, or [drift]."
            )
    return problems


def system_problems(
    model: Model, ramps: Sequence[Ramp], values: Parameters, axes: Mapping[str, Range], hz: float | None
) -> list[str]:
    """Return the reasons why a model's equations do not allow its parameters to move; this imports the compiler."""
    from magpend_core.models.drift.sections import Drift
    from magpend_core.models.drift.structure import DriftError

    try:
        Drift.of(model.system, ramps, values.names, *corners_of(values, axes, hz))
    except DriftError as error:
        return [f"drift.{error.parameter}: {error}"]
    return []
