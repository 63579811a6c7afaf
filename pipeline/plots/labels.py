"""Make axis labels and captions from the symbols and units of states, parameters and quantities.

Names, symbols and units come from the model and from the dataset's coordinates; none is hard-coded here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.ticker import Formatter, FuncFormatter, MultipleLocator

from pipeline.layout.conventions import shown_unit
from pipeline.layout.vocabulary import ORIGIN, axis_name, model_of, overrides_of
from pipeline.plots.style import check_choice, join

if TYPE_CHECKING:
    from magpend_core.models.model import Model

_DEGREE_STEPS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 45, 90, 180, 360)
_PI_STEPS = tuple(0.125 * 2**k for k in range(24))


OMEGA = r"$\omega$"
RATE_AXES = ("frequency", "omega", "drive_period")
"""Dims of the drive's rate, which maps show on the horizontal axis."""
MATH_SPACE = r"\ "


@dataclass(frozen=True)
class Measure:
    """Presentation of a state or quantity on an axis: its symbol, its unit, and the factor to this unit."""

    name: str
    symbol: str  # for an axis: between dollar signs, or the plain name
    unit: str  # unit on the axis
    factor: float = 1.0  # factor from the stored unit to the unit on the axis
    on_circle: bool = False  # whether values that differ by full turns are the same

    @property
    def label(self) -> str:
        """Label of the axis: symbol and unit."""
        return with_unit(self.symbol, self.unit)

    @property
    def half_turn(self) -> float:
        """Half a turn in the unit of the axis."""
        return math.pi * self.factor

    def shown(self, values: np.ndarray, *, wrap: bool = False) -> np.ndarray:
        """Convert values to the unit of the axis; with `wrap`, wrap angles to [-pi, pi) first."""
        folded = wrapped(values) if wrap and self.on_circle else values
        return np.asarray(folded * self.factor if self.factor != 1.0 else folded)


def with_unit(name: str, unit: str) -> str:
    """Return an axis label from a name and a unit; the unit is left out if it is 1."""
    return name if unit in ("", "1") else f"{name} [{raised(unit)}]"


def raised(unit: str) -> str:
    """Write the powers of a unit as superscripts: m/s2 or m/s^2 as m/s²."""
    return re.sub(r"(?<=[A-Za-z])\^?([23])(?!\d)", lambda power: {"2": "²", "3": "³"}[power[1]], unit)


def state_measure(ds: xr.Dataset, state: str = "", degrees: bool = False) -> Measure:
    """Return how a state is shown on an axis: its symbol, its unit and the factor to this unit.

    The default state is the first one whose values differ between section points. Raise ValueError if the model has no
    such state, or `degrees` are asked for of one that is no angle.
    """
    model = model_of(ds)
    state = state or model.section_states[0]
    check_choice("state", state, model.state_names)
    one = model.state(state)
    return _measure(one.name, one.symbol, one.unit, degrees, one.on_circle)


def quantity_measure(ds: xr.Dataset, name: str, degrees: bool = False) -> Measure:
    """Return how a quantity of the model is shown on an axis; raise ValueError if the model has none of this name."""
    model = model_of(ds)
    if name in model.state_names:
        return state_measure(ds, name, degrees)
    check_choice("quantity", name, (*(q.name for q in model.quantities), *model.state_names))
    one = model.quantity(name)
    return _measure(one.name, one.symbol, one.unit, degrees, False)


def _measure(name: str, symbol: str, unit: str, degrees: bool, on_circle: bool) -> Measure:
    written = f"${symbol}$" if symbol else name.replace("_", " ")
    turning = unit == "rad" or unit.startswith("rad/")
    if degrees and not turning:
        raise ValueError(f"{name} [{unit}] is no angle; draw it without degrees")
    if degrees:
        return Measure(name, written, unit.replace("rad", "deg", 1), 180.0 / math.pi, on_circle)
    return Measure(name, written, unit, 1.0, on_circle)


def start_measure(ds: xr.Dataset, dim: str, degrees: bool = False) -> Measure:
    """Return how the initial value of a state is shown on an axis."""
    model = model_of(ds)
    one = model.state(dim.removesuffix("_0"))
    origin = ds.coords[dim].attrs.get(ORIGIN, "") if dim in ds.coords else ""
    return _measure(
        dim,
        f"{one.symbol or one.name.replace('_', MATH_SPACE)}(0)" + (f" \u2212 ({origin})" if origin else ""),
        one.unit,
        degrees and one.unit.startswith("rad"),
        one.on_circle,
    )


def some_angle(model: Model, degrees: bool, what: str) -> None:
    """Raise ValueError if degrees are requested for a model without angles."""
    if degrees and not any(s.unit.startswith("rad") for s in model.states):
        raise ValueError(f"{what} of {model.name} have no angle; draw them without degrees")


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Wrap angles to [-pi, pi)."""
    return np.asarray((angle + math.pi) % (2.0 * math.pi) - math.pi)


def on_circle(angle: np.ndarray, *others: np.ndarray) -> tuple[np.ndarray, ...]:
    """Wrap an angle to [-pi, pi), and insert NaN where it jumps, in the angle and in the other arrays."""
    folded = wrapped(angle)
    jumps = np.flatnonzero(np.abs(np.diff(folded)) > math.pi) + 1
    return tuple(np.insert(values, jumps, np.nan) for values in (folded, *others))


def angle_ticks(ax: Axes, measure: Measure, axis: str = "y", most: float | None = None) -> None:
    """Set round ticks on the axis of an angle: fractions of pi in radians, or steps such as 30 in degrees."""
    if not measure.on_circle:
        return
    low, high = ax.get_ylim() if axis == "y" else ax.get_xlim()
    span = abs(high - low)
    most = most or (8.5 if axis == "y" else 4.5)
    if measure.factor != 1.0 and span > 0.5:
        _set_step(ax, axis, _step(span, most, _DEGREE_STEPS), None)
    elif measure.factor == 1.0 and span > 0.75 * math.pi:
        _set_step(ax, axis, _step(span / math.pi, most, _PI_STEPS) * math.pi, FuncFormatter(pi_fraction))


def _step(span: float, most: float, steps: Sequence[float]) -> float:
    return next((step for step in steps if span / step <= most), steps[-1])


def _set_step(ax: Axes, axis: str, step: float, formatter: Formatter | None) -> None:
    target = ax.yaxis if axis == "y" else ax.xaxis
    target.set_major_locator(MultipleLocator(step))
    if formatter is not None:
        target.set_major_formatter(formatter)


def pi_fraction(value: float, _position: int | None = None) -> str:
    """Format an angle, a multiple of pi/8, as a fraction of pi."""
    eighths = round(8.0 * value / math.pi)
    if eighths == 0:
        return "0"
    divisor = math.gcd(eighths, 8)
    numerator, denominator = abs(eighths) // divisor, 8 // divisor
    sign = "\N{MINUS SIGN}" if eighths < 0 else ""
    factor = "" if numerator == 1 else str(numerator)
    return f"{sign}{factor}π" + ("" if denominator == 1 else f"/{denominator}")


def parameter_label(coordinate: xr.DataArray) -> str:
    """Return the axis label of a parameter: its name and its unit."""
    name = str(coordinate.attrs.get("long_name", coordinate.name))
    if coordinate.name == "frequency":
        name = "drive frequency"
    if coordinate.name == "omega":
        name = f"{name} {OMEGA}".removeprefix("omega ")
    return with_unit(name, shown_unit(coordinate.attrs, "Hz" if coordinate.name == "frequency" else ""))


def swept_label(name: str, units: str) -> str:
    """Return the axis label of the parameter along which branches are continued."""
    if name in ("frequency", "frequency_hz"):
        return "drive frequency [Hz]"
    return with_unit({"omega": OMEGA, "drive_period": "drive period"}.get(name, name), units)


def caption(ds: xr.Dataset, *, drop: Iterable[str] = (), with_start: bool = True) -> str:
    """Return a caption with the fixed values of a figure: parameters, then the initial state.

    Fixed values are scalar coordinates and dims of size 1, except the dims in `drop`, and the parameters that the
    specification sets in place of its preset's.
    """
    along = (axis_name(str(ds.attrs.get(f"{role}parameter", ""))) for role in ("", "first_", "second_"))
    axes, states = {*drop, *along}, set(model_of(ds).state_names)
    parameters: list[str] = []
    starts: list[str] = []
    for key in sorted(map(str, ds.coords)):
        coordinate = ds.coords[key]
        is_start = key.removesuffix("_0") in states and key.endswith("_0")
        if coordinate.size != 1 or coordinate.dtype.kind != "f" or key in axes:
            continue
        (starts if is_start else parameters).append(_value(ds, coordinate, is_start))
    for name, value in overrides_of(ds).items():
        if name not in axes and name not in ds.coords:
            parameters.append(_assignment(name, value, model_of(ds).parameter(name).unit))
    crossing = model_of(ds).crossing
    section = [] if crossing is None else [f"section {crossing.sentence}"]
    return join([*parameters, *section, *(starts if with_start else [])])


def _value(ds: xr.Dataset, coordinate: xr.DataArray, is_start: bool) -> str:
    name, unit = str(coordinate.name), shown_unit(coordinate.attrs)
    value = float(coordinate.values.ravel()[0])
    if is_start:
        measure = start_measure(ds, name)
        return _assignment(measure.symbol, value, measure.unit)
    if name == "frequency":
        # under a recorded drive the mean one
        mean = "mean " if str(coordinate.attrs.get("long_name", "")).startswith("mean") else ""
        return _assignment(f"{mean}$f$", value, "Hz")
    name = {"omega": OMEGA, "drive_period": "drive period"}.get(name, name)
    return _assignment(name, value, unit)


def _assignment(symbol: str, value: float, unit: str) -> str:
    return f"{symbol} = {value:.6g}" + ("" if unit in ("", "1") else f"\u00a0{raised(unit)}")
