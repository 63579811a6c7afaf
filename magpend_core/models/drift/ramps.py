"""Describe how one parameter moves in time: a linear ramp, a smooth ramp, or a table of values."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from magpend_core.models.parameters import Parameter

LINEAR, SMOOTH, TABLE = "linear", "tanh", "table"
SHAPES = (LINEAR, SMOOTH)

STEEPNESS = 5.0
"""Argument of the tanh at the end of a smooth ramp: its steepest slope is five times its mean slope."""

PER_PERIOD, PERIODS = "_per_period", "_periods"
NUMBERS = (
    *("from", "to", "rate_per_s", "rate_per_period", "start_s", "start_periods"),
    *("duration_s", "duration_periods", "hold_s", "hold_periods"),
)
"""Keys of a ramp's numbers, in the order of the run's parameters."""

WAY_BACK = ("hold_s", "hold_periods")
"""Keys of a ramp that goes back as it came, after this time at its second value."""


@dataclass(frozen=True)
class Ramp:
    """The motion of one parameter.

    Attributes
    ----------
    parameter : str
        Name of the parameter that moves.
    shape : str
        ``"linear"``, ``"tanh"``, or ``"table"`` for values that are interpolated linearly.
    numbers : tuple of (str, float)
        The numbers that are given, by their keys among `NUMBERS`. Without ``from`` the ramp begins at the
        parameter's own value.
    times_s, values : tuple of float
        Of a table: rising times [s since its start] and the parameter's values.
    """

    parameter: str
    shape: str
    numbers: tuple[tuple[str, float], ...] = ()
    times_s: tuple[float, ...] = ()
    values: tuple[float, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the run's parameters that hold the ramp's numbers, such as ``q_rate_per_s``."""
        return tuple(f"{self.parameter}_{key}" for key, _ in self.numbers)

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of the given numbers."""
        return tuple(key for key, _ in self.numbers)

    @property
    def is_smooth(self) -> bool:
        """Whether the ramp has the shape of a tanh."""
        return self.shape == SMOOTH

    @property
    def way_out(self) -> Ramp:
        """The motion up to where it turns: without the way back, or a table up to its value farthest from the first."""
        if self.shape != TABLE:
            return replace(self, numbers=tuple((k, v) for k, v in self.numbers if k not in WAY_BACK))
        last = max(int(np.abs(np.array(self.values) - self.values[0]).argmax()), 1)
        return replace(self, times_s=self.times_s[: last + 1], values=self.values[: last + 1])


def ramp_parameters(ramp: Ramp, unit: str) -> tuple[Parameter, ...]:
    """Return the declarations of the run's parameters that hold a ramp's numbers."""
    per = {"rate_per_s": "s", "rate_per_period": "period"}
    words = {
        "from": f"value of {ramp.parameter} before its ramp",
        "to": f"value of {ramp.parameter} after its ramp",
        "rate_per_s": f"mean rate of {ramp.parameter}",
        "rate_per_period": f"mean rate of {ramp.parameter}",
    }
    found = []
    for key, name in zip(ramp.keys, ramp.names, strict=True):
        if key in per:
            one = f"{unit}/{per[key]}" if unit not in ("", "1") else f"1/{per[key]}"
        else:
            one = unit if key in ("from", "to") else "s" if key.endswith("_s") else "1"
        what = key.partition("_")[0]
        found.append(Parameter(name, one, words.get(key, f"{what} of the ramp of {ramp.parameter}")))
    return tuple(found)


@dataclass(frozen=True)
class RampOfCells:
    """A ramp with its numbers, for many cells.

    Attributes
    ----------
    ramp : Ramp
    begin, end : ndarray, (cell,)
        Values before and after [the parameter's unit].
    start_s, duration_s : ndarray, (cell,)
        Of the ramp, or of a table [s since the trajectory's start].
    hold_s : ndarray, (cell,), or None
        Time at the value `end` before the parameter goes back as it came [s]; None if it stays there.
    """

    ramp: Ramp
    begin: np.ndarray
    end: np.ndarray
    start_s: np.ndarray
    duration_s: np.ndarray
    hold_s: np.ndarray | None = None

    @property
    def end_s(self) -> np.ndarray:
        """Time after which the parameter stays where it is, shape (cell,) [s]."""
        back = 0.0 if self.hold_s is None else self.hold_s + self.duration_s
        return np.asarray(self.start_s + self.duration_s + back)

    @property
    def final(self) -> np.ndarray:
        """Value at which the parameter stays at last, shape (cell,) [the parameter's unit]."""
        return self.end if self.hold_s is None else self.begin

    def share(self, cell: int, times: np.ndarray) -> np.ndarray:
        """Return how far the parameter of a cell is on the way to its value `end` at given times, from 0 to 1."""
        come = times - self.start_s[cell]
        if self.hold_s is not None:
            come = np.minimum(come, self.end_s[cell] - times)
        return np.asarray(np.clip(come / self.duration_s[cell], 0.0, 1.0))

    def at(self, cell: int, times: np.ndarray) -> np.ndarray:
        """Return the parameter's value of a cell at given times [s since the trajectory's start]."""
        if self.ramp.shape == TABLE:
            own = np.asarray(self.ramp.times_s) + self.start_s[cell]
            return np.asarray(np.interp(times, own, self.ramp.values))
        return np.asarray(value_at(self.ramp, self.begin[cell], self.end[cell], self.share(cell, times)))

    def corners(self, cell: int, pieces: int) -> np.ndarray:
        """Return the times at which the parameter's motion has a corner or a new piece begins, rising [s].

        Parameters
        ----------
        cell
            Number of the cell.
        pieces
            Equal parts into which the ramp is split (see `structure`); of a table, each stretch between two
            of its times is split so that no part covers more than this part of the table's range.
        """
        if self.ramp.shape != TABLE:
            way = self.start_s[cell] + self.duration_s[cell] * (np.arange(pieces + 1) / pieces)
            if self.hold_s is None:
                return np.asarray(way)
            return np.concatenate([way, way + (self.duration_s[cell] + self.hold_s[cell])])
        times, values = np.asarray(self.ramp.times_s), np.asarray(self.ramp.values)
        if pieces > 1:
            limit = max(float(np.ptp(values)), 1e-300) / pieces
            parts = np.maximum(1, np.ceil(np.abs(np.diff(values)) / limit)).astype(int)
            between = [t + (u - t) * (np.arange(n) / n) for t, u, n in zip(times[:-1], times[1:], parts, strict=True)]
            times = np.append(np.concatenate(between), times[-1])
        return np.asarray(self.start_s[cell] + times)


def value_at(ramp: Ramp, begin: Any, end: Any, share: Any) -> Any:
    """Return the value of a ramp that has come as far as `share`, from 0 to 1."""
    if ramp.is_smooth:
        return begin + (end - begin) * (0.5 + 0.5 * np.tanh(STEEPNESS * (2.0 * share - 1.0)) / math.tanh(STEEPNESS))
    # in this form both ends are exact
    return begin * (1.0 - share) + end * share


def motion_of(ramp: Ramp, value_of: Callable[[str], np.ndarray], frequency_hz: np.ndarray) -> RampOfCells:
    """Return a ramp with its numbers for many cells.

    Parameters
    ----------
    ramp
        The ramp.
    value_of
        Function from the name of a parameter of the run to its values, shape (cell,).
    frequency_hz
        Drive frequency, shape (cell,) [Hz].
    """
    given = {key: np.asarray(value_of(name)) for key, name in zip(ramp.keys, ramp.names, strict=True)}
    for key in tuple(given):
        if key.endswith(PER_PERIOD):
            given[f"{key.removesuffix(PER_PERIOD)}_per_s"] = given[key] * frequency_hz
        elif key.endswith(PERIODS):
            given[f"{key.removesuffix(PERIODS)}_s"] = given[key] / frequency_hz
    zero = np.zeros_like(frequency_hz)
    start = given.get("start_s", zero) + zero
    if ramp.shape == TABLE:
        first, last = ramp.values[0], ramp.values[-1]
        return RampOfCells(ramp, zero + first, zero + last, start, zero + ramp.times_s[-1])
    begin = given["from"] if "from" in given else np.asarray(value_of(ramp.parameter))
    with np.errstate(divide="ignore", invalid="ignore"):
        if "to" not in given:
            duration = given["duration_s"]
            end = begin + given["rate_per_s"] * duration
        else:
            end = given["to"]
            duration = given["duration_s"] if "duration_s" in given else (end - begin) / given["rate_per_s"]
    hold = given["hold_s"] + zero if "hold_s" in given else None
    return RampOfCells(ramp, begin + zero, end + zero, start, duration + zero, hold)


def motions_of(
    ramps: Sequence[Ramp], names: Sequence[str], packed: np.ndarray, frequency_hz: np.ndarray
) -> tuple[RampOfCells, ...]:
    """Return the motions of all ramps for cells with packed parameters.

    Parameters
    ----------
    ramps
        The ramps.
    names
        Names of the packed parameters, those of the ramps' numbers included.
    packed
        Shape (cell, len(names)).
    frequency_hz
        Shape (cell,) [Hz].
    """
    place = {name: i for i, name in enumerate(names)}
    return tuple(motion_of(ramp, lambda name: packed[:, place[name]], frequency_hz) for ramp in ramps)


def ramps_as_data(ramps: Sequence[Ramp]) -> list[dict[str, Any]]:
    """Return ramps as plain data for `ramps_from_data`, without the rows of tables, which can be many."""
    return [{"parameter": ramp.parameter, "shape": ramp.shape, "numbers": dict(ramp.numbers)} for ramp in ramps]


def ramps_from_data(data: Sequence[Mapping[str, Any]]) -> tuple[Ramp, ...]:
    """Return the ramps that `ramps_as_data` has written as plain data; tables are without their rows."""
    return tuple(
        Ramp(str(one["parameter"]), str(one["shape"]), tuple((str(k), float(v)) for k, v in one["numbers"].items()))
        for one in data
    )
