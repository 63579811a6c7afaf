"""Define the tables of a specification that are the same for every model."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Annotated, Any, ClassVar, Final, Literal

import numpy as np
from pydantic import BaseModel, Discriminator, Field, Tag, model_validator

from magpend_core import defaults
from magpend_core.models.presets import Preset
from pipeline.products.product import STRICT

FREQUENCY = "frequency_hz"
"""Name of the drive frequency among the parameters."""


@dataclass(frozen=True)
class Rate:
    """A word for the drive's rate, with its unit and the factor that converts it to Hz."""

    column: str  # in tables, where period is the number of drive periods of an orbit
    meaning: str
    unit: str
    factor: float = 1.0
    inverse: bool = False  # whether it is a time

    def hertz(self, given: Any) -> Any:
        """Return the frequency [Hz] for a value in this word; for arrays, too."""
        return 1.0 / given if self.inverse else given / self.factor

    def given(self, hertz: Any) -> Any:
        """Return the value in this word for a frequency [Hz]; for arrays, too."""
        return 1.0 / hertz if self.inverse else hertz * self.factor

    def slope(self, hertz: Any) -> Any:
        """Return the size of the derivative of `given` by the frequency."""
        return hertz**-2.0 if self.inverse else self.factor


RATES = {
    FREQUENCY: Rate(FREQUENCY, "drive frequency", "Hz"),
    "omega": Rate("omega", "angular drive frequency", "rad/s", 2.0 * math.pi),
    "period": Rate("drive_period", "drive period", "s", inverse=True),
}
"""Words by which the drive's rate may be given. Cubes hold the frequency."""

MAX_POINTS = 10_000_000
EXACT = 2**53
"""Largest bound up to which all whole numbers are exact in float64."""


def word_named(name: str) -> str:
    """Return the word for the drive's rate that a name of it in options or tables stands for; empty if it is none."""
    return next((word for word, rate in RATES.items() if name in (word, rate.column)), "")


class Table(BaseModel):
    """A table of the specification: strict types, no unknown keys, no NaN or infinity."""

    model_config = STRICT
    nested_model: ClassVar[type[BaseModel] | None] = None


class Range(Table):
    """Increasing values of an axis, given as ``start, stop, num``, as ``start, stop, step``, or as ``values``."""

    start: float | None = Field(default=None, description="First value.")
    stop: float | None = Field(default=None, description="Last value; with step, an upper bound.")
    num: Annotated[int, Field(ge=2, le=MAX_POINTS)] | None = Field(
        default=None, description="Number of evenly spaced values, both ends included."
    )
    step: Annotated[float, Field(gt=0)] | None = Field(default=None, description="Spacing, instead of num.")
    values: Annotated[tuple[float, ...], Field(strict=False, min_length=1)] | None = Field(
        default=None, description="All values, instead of the other keys."
    )

    @model_validator(mode="after")
    def _one_form(self) -> Range:
        given = frozenset(self.model_dump(exclude_none=True))
        forms = [{"start", "stop", "num"}, {"start", "stop", "step"}, {"values"}]
        if given not in forms:
            have = ", ".join(sorted(given)) or "nothing"
            raise ValueError(f"give start, stop and num, or start, stop and step, or values alone (given: {have}).")
        if self.values is not None:
            if any(b <= a for a, b in itertools.pairwise(self.values)):
                raise ValueError("values must rise strictly; sort them and drop repeated ones.")
        elif self.start is not None and self.stop is not None:
            if self.stop <= self.start:
                raise ValueError(
                    f"stop = {self.stop!r} must be greater than start = {self.start!r}; "
                    "for one value give values = [x]; to continue downwards set continuation.direction."
                )
            if self.step is not None and (self.stop - self.start) / self.step >= MAX_POINTS:
                raise ValueError(f"step = {self.step!r} makes more than {MAX_POINTS} points; make it larger.")
        return self

    @property
    def n(self) -> int:
        """Number of values, computed without creating the array."""
        if self.values is not None or self.num is not None:
            return self.num or len(self.values or ())
        start, stop, step = (Fraction(repr(x)) for x in (self.start, self.stop, self.step))
        return (stop - start) // step + 1

    def array(self) -> np.ndarray:
        """Return the values that cells have."""
        return self.given()

    def given(self) -> np.ndarray:
        """Return the values as they are given, each rounded once from its exact decimal number to float64."""
        if self.values is not None:
            return np.array(self.values, dtype=np.float64)
        start, stop = Fraction(repr(self.start)), Fraction(repr(self.stop))
        if self.num is not None:
            step, num = (stop - start) / (self.num - 1), self.num
        else:
            step = Fraction(repr(self.step))
            num = (stop - start) // step + 1
        # one division rounds once: in numpy if all whole numbers are exact in float64, else in Python
        below = math.lcm(start.denominator, step.denominator)
        first, each = (int(part * below) for part in (start, step))
        if max(abs(first), abs(first + (num - 1) * each), below) <= EXACT:
            return np.asarray((first + each * np.arange(num)) / below)
        return np.array([(first + i * each) / below for i in range(num)], dtype=np.float64)


class OmegaRange(Range):
    """Angular frequencies of the drive [rad/s]; `array` has the frequencies [Hz]."""

    word: ClassVar[str] = "omega"

    def array(self) -> np.ndarray:
        """Return the frequencies of the drive [Hz], rising."""
        found: np.ndarray = np.sort(RATES[self.word].hertz(self.given()))
        return found


class PeriodRange(OmegaRange):
    """Periods of the drive [s]; `array` has the frequencies [Hz]."""

    word: ClassVar[str] = "period"


RANGES: dict[str, type[Range]] = {FREQUENCY: Range, "omega": OmegaRange, "period": PeriodRange}


def word_of(axis: Range | None) -> str:
    """Return the word in which an axis gives the drive's rate."""
    return axis.word if isinstance(axis, OmegaRange) else FREQUENCY


class PresetTable(Table):
    """Content of a preset file (parameter values), stored so that the file is no longer needed."""

    name: str
    model: str
    base: str = ""
    title: str = ""
    values: dict[str, float]
    provenance: dict[str, str]

    def preset(self) -> Preset:
        """Return the table as a `Preset` object."""
        return Preset(**self.model_dump())


def _name_or_table(value: Any) -> str:
    return "(table)" if isinstance(value, dict | PresetTable) else "(name)"


class ParametersTable(Table):
    """The table ``[parameters]``: the preset, values that replace the preset's, and the drive frequency unless it is
    swept.
    """

    nested_model: ClassVar[type[BaseModel] | None] = PresetTable
    preset: (
        Annotated[Annotated[str, Tag("(name)")] | Annotated[PresetTable, Tag("(table)")], Discriminator(_name_or_table)]
        | None
    ) = Field(
        default=None,
        description="Preset of the model, by default the first; or a preset's file, FILE.toml, relative to "
        "the specification.",
    )
    overrides: dict[str, float] = Field(default={}, description="Values by parameter name, in SI units.")
    frequency_hz: Annotated[float, Field(gt=0)] | None = Field(
        default=None, description="Drive frequency [Hz], unless it is an axis."
    )
    omega: Annotated[float, Field(gt=0)] | None = Field(
        default=None, description="Angular frequency of the drive [rad/s], instead of frequency_hz."
    )
    period: Annotated[float, Field(gt=0)] | None = Field(
        default=None, description="Period of the drive [s], instead of frequency_hz."
    )

    @property
    def rates(self) -> tuple[str, ...]:
        """Words in which the drive's rate is given: one, or none if it is swept."""
        return tuple(word for word in RATES if getattr(self, word) is not None)

    @property
    def hertz(self) -> float | None:
        """Drive frequency [Hz]; None if it is swept."""
        return RATES[self.rates[0]].hertz(getattr(self, self.rates[0])) if self.rates else None

    @property
    def chosen(self) -> str | Preset | None:
        """Preset of parameter values, as a name or a `Preset` object for `Model.load`."""
        return self.preset.preset() if isinstance(self.preset, PresetTable) else self.preset


class Continuation(Table):
    """The table ``[continuation]``: the parameter axis along which branches are followed, and the direction."""

    path: str = Field(default=FREQUENCY, description="Axis that the branches follow: the continuation parameter.")
    direction: Literal["up", "down", "both"] = Field(
        default="up", description="Direction in which the branches follow it."
    )

    @property
    def directions(self) -> tuple[str, ...]:
        """Directions of the continuation: up, down, or both in turn."""
        return ("up", "down") if self.direction == "both" else (self.direction,)


AUTO: Final = "auto"
"""Method of a specification until one is decided for its run, see `pipeline.runs.methods`."""

EXPLICIT: Final = "dopri5"
"""Method of a run that is not stiff, and of what is integrated without a run."""

STIFF: Final = "rodas5p"
"""Method of a run that is stiff."""


class Integration(Table):
    """The table ``[integration]``: tolerances, length of the transient, and section points kept for each trajectory."""

    rtol: float = Field(default=defaults.RTOL, ge=1e-13, lt=1, description="Relative tolerance of a step.")
    atol: float = Field(
        default=defaults.ATOL,
        gt=0,
        lt=1,
        description="Absolute tolerance of a step, in the states' units; or in units of the sizes "
        "that the motion gave them.",
    )
    method: Literal["auto", "dopri5", "dop853", "rodas5p"] = Field(
        default=AUTO,
        description="Runge-Kutta method: dopri5 of order 5, dop853 of order 8 for smooth equations, or rodas5p for "
        "stiff ones; auto decides between dopri5 and rodas5p before the run begins.",
    )
    n_transient: int = Field(
        default=300, ge=0, le=100_000_000, description="Drive periods or returns before sections are kept."
    )
    n_keep: int = Field(default=60, ge=1, le=1_000_000, description="Sections kept, one per drive period or return.")
    max_steps_per_period: int = Field(
        default=defaults.MOST_STEPS,
        ge=1,
        le=1_000_000_000,
        description="Attempted steps after which a cell is given up.",
    )
    stop_when_closed: bool = Field(
        default=False, description="Keep sections as soon as the orbit has closed, without waiting for n_transient."
    )
    closure_tolerance: float = Field(
        default=defaults.CLOSURE,
        gt=0,
        lt=1,
        description="Scaled distance to a closed orbit below which a cell counts as closed.",
    )
    max_orbit_period: int = Field(
        default=defaults.LONGEST_PERIOD,
        ge=1,
        le=32_000,
        description="Longest orbit period that is detected [drive periods or returns].",
    )


class Execution(Table):
    """The table ``[execution]``: how many cells or points a task computes; affects the layout of the stored files but
    not the numbers.
    """

    trajectories_per_task: Annotated[int, Field(ge=1, le=MAX_POINTS)] | None = Field(
        default=None, description="Cells or branches of a task; by default chosen by chunk size and time."
    )
    points_per_task: Annotated[int, Field(ge=1, le=MAX_POINTS)] | None = Field(
        default=None, description="Points of the continuation that a task covers; by default chosen by time."
    )
