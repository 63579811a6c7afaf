"""The specification of a run: what a person writes in TOML, validated as a whole.

Two kinds: a *sweep*, in which every cell is independent, and a *continuation*, in which branches
walk a parameter path, each step starting where the last one ended. Units stand in the keys;
angles in degrees are converted once, in `cells`.
"""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    model_validator,
)

from magpend_core.models import load_preset
from magpend_core.models.parameters import ParameterError, Parameters, unknown_name_problem
from pipeline.spec.problems import SpecError, problems_of, unknown_choice, unknown_key

FREQUENCY = "frequency_hz"
STATES = ("psi1", "psi2", "psi1_dot", "psi2_dot")
KINDS = ("sweep", "continuation")
MAX_POINTS = 10_000_000
STRIDES = (2, 4, 8, 16, 32, 64)
MAX_TILE_BYTES = 256_000_000
"""Largest sections of the smallest tile that a refined grid can be cut into [bytes]."""


class Table(BaseModel):
    """A table of the specification: strict types, no unknown keys, no NaN or infinity."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, frozen=True)
    nested_model: ClassVar[type[BaseModel] | None] = None


class Range(Table):
    """Values in rising order: ``start, stop, num``, or ``start, stop, step``, or ``values``."""

    start: float | None = None
    stop: float | None = None
    num: Annotated[int, Field(ge=2, le=MAX_POINTS)] | None = None
    step: Annotated[float, Field(gt=0)] | None = None
    values: Annotated[tuple[float, ...], Field(strict=False, min_length=1)] | None = None

    @model_validator(mode="after")
    def _one_form(self) -> Range:
        given = frozenset(self.model_dump(exclude_none=True))
        forms = [{"start", "stop", "num"}, {"start", "stop", "step"}, {"values"}]
        if given not in forms:
            have = ", ".join(sorted(given)) or "nothing"
            raise ValueError(
                f"give start, stop and num, or start, stop and step, or values alone (given: {have})."
            )
        if self.values is not None:
            if any(b <= a for a, b in itertools.pairwise(self.values)):
                raise ValueError("values must rise strictly; sort them and drop repeated ones.")
        elif self.start is not None and self.stop is not None:
            if self.stop <= self.start:
                raise ValueError(
                    f"stop = {self.stop!r} must be greater than start = {self.start!r}; "
                    "for one value give values = [x]; to walk downwards set continuation.direction."
                )
            if self.step is not None and (self.stop - self.start) / self.step >= MAX_POINTS:
                raise ValueError(f"step = {self.step!r} makes more than {MAX_POINTS} points; make it larger.")
        return self

    def array(self) -> np.ndarray:
        """Return the values: the float64 nearest to each decimal number, as one would write it by hand."""
        if self.values is not None:
            return np.array(self.values, dtype=np.float64)
        start, stop = Fraction(repr(self.start)), Fraction(repr(self.stop))
        if self.num is not None:
            step, num = (stop - start) / (self.num - 1), self.num
        else:
            step = Fraction(repr(self.step))
            num = (stop - start) // step + 1
        return np.array([float(start + i * step) for i in range(num)], dtype=np.float64)


def _number_or_range(value: Any) -> str:
    return "(range)" if isinstance(value, (dict, Range)) else "(number)"


def _number_or_interval(value: Any) -> str:
    return "(interval)" if isinstance(value, (list, tuple)) else "(number)"


def _rising(interval: tuple[float, float]) -> tuple[float, float]:
    if interval[1] <= interval[0]:
        raise ValueError(f"[{interval[0]!r}, {interval[1]!r}]: the second number must be the greater one.")
    return interval


Extent = Annotated[
    Annotated[float, Tag("(number)")] | Annotated[Range, Tag("(range)")], Discriminator(_number_or_range)
]
Interval = Annotated[
    Annotated[float, Tag("(number)")]
    | Annotated[tuple[float, float], Field(strict=False), Tag("(interval)")],
    Discriminator(_number_or_interval),
]
Rows = Annotated[
    tuple[Annotated[tuple[float, ...], Field(strict=False)], ...], Field(strict=False, min_length=1)
]


class ParametersTable(Table):
    """``[parameters]``: the preset, what differs from it, and the frequency unless it is an axis."""

    preset: str = "wojna2018"
    overrides: dict[str, float] = {}
    frequency_hz: Annotated[float, Field(gt=0)] | None = None

    def load(self) -> Parameters:
        """Return the core's parameters; raises `ParameterError`."""
        return load_preset(self.preset, **self.overrides)


class _PerState(Table):
    @model_validator(mode="after")
    def _one_unit(self) -> _PerState:
        for state in STATES:
            if getattr(self, state) is not None and getattr(self, f"{state}_deg") is not None:
                raise ValueError(f"{state} and {state}_deg are both given; keep one.")
        return self


def _power_of_two(stride: int) -> int:
    if stride not in STRIDES:
        raise ValueError(f"{stride} is not among {', '.join(map(str, STRIDES))}; take one of these.")
    return stride


class GridStarts(_PerState):
    """``[initial_conditions] kind = "grid"``: ranges span the grid, numbers are fixed, the rest is 0.

    With `refine` a sweep computes every `refine`-th cell first; see `pipeline.compute.refinement`.
    """

    nested_model: ClassVar[type[BaseModel] | None] = Range

    kind: Literal["grid"]
    refine: Annotated[int, AfterValidator(_power_of_two)] | None = None
    psi1: Extent | None = None
    psi1_deg: Extent | None = None
    psi2: Extent | None = None
    psi2_deg: Extent | None = None
    psi1_dot: Extent | None = None
    psi1_dot_deg: Extent | None = None
    psi2_dot: Extent | None = None
    psi2_dot_deg: Extent | None = None

    @property
    def ranges(self) -> dict[str, Range]:
        """What spans the grid, by key."""
        return {key: value for key, value in self if isinstance(value, Range)}


class ListStarts(Table):
    """``[initial_conditions] kind = "list"``: rows of psi1, psi2 and, if not 0, psi1_dot, psi2_dot."""

    kind: Literal["list"]
    points: Rows | None = None
    points_deg: Rows | None = None

    @model_validator(mode="after")
    def _rows(self) -> ListStarts:
        if (self.points is None) == (self.points_deg is None):
            raise ValueError("give points (rad, rad/s) or points_deg (degrees, degrees/s), one of them.")
        for i, row in enumerate(self.points or self.points_deg or ()):
            if len(row) not in (2, 4):
                raise ValueError(
                    f"row {i} has {len(row)} numbers; give psi1, psi2 or psi1, psi2, psi1_dot, psi2_dot."
                )
        return self


class RandomStarts(_PerState):
    """``[initial_conditions] kind = "random"``: seeded uniform samples of a box ``[low, high]`` per state."""

    kind: Literal["random"]
    n: Annotated[int, Field(ge=1, le=MAX_POINTS)]
    seed: Annotated[int, Field(ge=0)] = 0
    psi1: Interval | None = None
    psi1_deg: Interval | None = None
    psi2: Interval | None = None
    psi2_deg: Interval | None = None
    psi1_dot: Interval | None = None
    psi1_dot_deg: Interval | None = None
    psi2_dot: Interval | None = None
    psi2_dot_deg: Interval | None = None

    @model_validator(mode="after")
    def _boxes(self) -> RandomStarts:
        for key, value in self:
            if isinstance(value, tuple):
                try:
                    _rising(value)
                except ValueError as error:
                    raise ValueError(f"{key} = {error}") from None
        return self


Starts = GridStarts | ListStarts | RandomStarts
_STARTS: dict[str, type[Starts]] = {"grid": GridStarts, "list": ListStarts, "random": RandomStarts}


class Continuation(Table):
    """``[continuation]``: which axis the branches walk, and which way."""

    path: str = FREQUENCY
    direction: Literal["up", "down", "both"] = "up"

    @property
    def directions(self) -> tuple[str, ...]:
        """The directions walked, one or two."""
        return ("up", "down") if self.direction == "both" else (self.direction,)


class Integration(Table):
    """``[integration]``: tolerances, and what is discarded and kept of each cell."""

    rtol: Annotated[float, Field(ge=1e-13, lt=1)] = 1e-8
    atol: Annotated[float, Field(gt=0, lt=1)] = 1e-8
    n_transient: Annotated[int, Field(ge=0, le=100_000_000)] = 300
    n_keep: Annotated[int, Field(ge=1, le=1_000_000)] = 60
    max_steps_per_period: Annotated[int, Field(ge=1, le=1_000_000_000)] = 20_000
    stop_when_closed: bool = False
    closure_tolerance: Annotated[float, Field(gt=0, lt=1)] = 1e-6
    max_orbit_period: Annotated[int, Field(ge=1, le=32_000)] = 16


class Lyapunov(Table):
    """``products.lyapunov``: exponents along each cell's attractor, from its last kept section on.

    `n_exponents` from the largest, `n_transient` drive periods in which the tangent vectors turn into
    their directions, then `n_periods` in `n_blocks` blocks.
    """

    n_exponents: Annotated[int, Field(ge=1, le=len(STATES))] = len(STATES)
    n_transient: Annotated[int, Field(ge=0, le=1_000_000)] = 200
    n_periods: Annotated[int, Field(ge=2, le=100_000_000)] = 400
    n_blocks: Annotated[int, Field(ge=2, le=1000)] = 16

    @model_validator(mode="after")
    def _whole_blocks(self) -> Lyapunov:
        if self.n_periods % self.n_blocks:
            nearest = -(-self.n_periods // self.n_blocks) * self.n_blocks
            raise ValueError(
                f"n_periods = {self.n_periods} must be a multiple of n_blocks = {self.n_blocks}, "
                f"such as {nearest}."
            )
        return self


class Products(Table):
    """``[products]``: what is computed of each cell besides its sections."""

    nested_model: ClassVar[type[BaseModel] | None] = Lyapunov

    lyapunov: Lyapunov | None = None


class Execution(Table):
    """``[execution]``: sizes of tasks. They decide the layout of the store, never the numbers."""

    trajectories_per_task: Annotated[int, Field(ge=1, le=MAX_POINTS)] | None = None


@dataclass(frozen=True)
class Spec:
    """A valid specification; each attribute is a table of the TOML file."""

    kind: str
    title: str
    parameters: ParametersTable
    axes: dict[str, Range]
    initial_conditions: Starts
    continuation: Continuation | None
    integration: Integration
    products: Products
    execution: Execution

    @property
    def refine(self) -> int | None:
        """Stride of a refined grid; None for a full one and for other starts."""
        starts = self.initial_conditions
        return starts.refine if isinstance(starts, GridStarts) else None

    def as_dict(self) -> dict[str, Any]:
        """Return plain data with all defaults filled in; `parse_spec` reads it back."""
        tables: dict[str, Any] = {"kind": self.kind, "title": self.title}
        names = ("parameters", "initial_conditions", "continuation", "integration", "products", "execution")
        for name in names:
            table = getattr(self, name)
            if table is not None:
                tables[name] = table.model_dump(mode="json", exclude_none=True)
        tables["axes"] = {
            name: axis.model_dump(mode="json", exclude_none=True) for name, axis in self.axes.items()
        }
        return tables


_TABLES: dict[str, type[Table]] = {
    "parameters": ParametersTable,
    "continuation": Continuation,
    "integration": Integration,
    "products": Products,
    "execution": Execution,
}
_KEYS = (
    "kind",
    "title",
    "parameters",
    "axes",
    "initial_conditions",
    "continuation",
    "integration",
    "products",
    "execution",
)


def load_spec(path: str | Path, *, smoke: bool = False) -> Spec:
    """Read and validate a specification.

    Parameters
    ----------
    path
        A TOML file.
    smoke
        Apply the file's ``[smoke]`` table, which makes the run one of seconds.

    Raises
    ------
    SpecError
        With all problems at once; also if the file cannot be read or is not TOML.
    """
    return parse_spec(_with_smoke(read_toml(path), smoke))


def read_toml(path: str | Path) -> dict[str, Any]:
    """Return the tables of a TOML file; raises `SpecError` if it cannot be read."""
    try:
        return tomllib.loads(Path(path).read_text("utf-8"))
    except OSError as error:
        raise SpecError([f"{path}: cannot be read ({error.strerror or error})."]) from None
    except UnicodeDecodeError:
        raise SpecError([f"{path}: is not text in UTF-8; a specification is a TOML file."]) from None
    except tomllib.TOMLDecodeError as error:
        raise SpecError([f"{path}: is not valid TOML: {error}."]) from None


def _with_smoke(data: dict[str, Any], smoke: bool) -> dict[str, Any]:
    """Split off ``[smoke]``, check it in either case, and merge it if asked."""
    plain = {key: value for key, value in data.items() if key != "smoke"}
    if "smoke" not in data:
        if smoke:
            raise SpecError(["smoke: this specification has no [smoke] table; add one or run it in full."])
        return plain
    table = data["smoke"]
    if not isinstance(table, dict):
        raise SpecError([f"smoke = {table!r}: must be a table of keys to replace."])
    merged = _merge(plain, _nested(table))
    try:
        parse_spec(merged)
    except SpecError as error:
        _raise_new(plain, error)
    return merged if smoke else plain


def _raise_new(plain: dict[str, Any], smoke_error: SpecError) -> None:
    """Raise the plain problems together with those that the smoke table brings."""
    try:
        parse_spec(plain)
        own: list[str] = []
    except SpecError as error:
        own = error.problems
    raise SpecError(own + [f"with [smoke]: {p}" for p in smoke_error.problems if p not in own])


def _nested(table: Mapping[str, Any]) -> dict[str, Any]:
    """Spread quoted dotted keys: ``{"a.b": 1}`` becomes ``{"a": {"b": 1}}``."""
    result: dict[str, Any] = {}
    for key, value in table.items():
        *parents, last = key.split(".")
        inner = _nested(value) if isinstance(value, dict) else value
        for parent in reversed(parents):
            inner, last = {last: inner}, parent
        result = _merge(result, {last: inner})
    return result


def _merge(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return `base` with the leaves of `changes` put in; tables merge, everything else is replaced."""
    result = dict(base)
    for key, value in changes.items():
        old = result.get(key)
        result[key] = _merge(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return result


def parse_spec(data: Mapping[str, Any]) -> Spec:
    """Validate plain data.

    Every table is validated by itself, so that one with errors does not hide those of the others;
    then whatever can be checked between the valid ones is.

    Raises
    ------
    SpecError
        With all problems at once.
    """
    problems = [unknown_key(key, key, _KEYS) for key in data if key not in _KEYS]
    kind, title = _kind(data, problems), _title(data, problems)
    tables = {name: _table(data, name, model, problems) for name, model in _TABLES.items()}
    axes = _axes(data, problems)
    starts = _starts(data, problems)
    problems += _refine_problems(kind, starts, tables["integration"])
    walk = _walk(kind, data, tables["continuation"], axes, problems)
    known = _valid_keys(ParametersTable, data.get("parameters", {}))
    complete = not any(p.startswith(("axes", "parameters")) for p in problems)
    problems += _parameter_problems(known, _declared(data), axes, complete)
    if problems:
        raise SpecError(problems)
    assert starts is not None
    return Spec(
        kind,
        title,
        tables["parameters"],
        axes,
        starts,
        walk,
        tables["integration"],
        tables["products"],
        tables["execution"],
    )


def _declared(data: Mapping[str, Any]) -> tuple[str, ...]:
    """Names of all axes, valid or not."""
    axes = data.get("axes", {})
    return tuple(axes) if isinstance(axes, dict) else ()


def _valid_keys(model: type[ParametersTable], table: Any) -> ParametersTable:
    """Return what is valid of a table, so that its errors do not hide others."""
    valid: dict[str, Any] = {}
    for key, value in table.items() if isinstance(table, dict) else ():
        if _validate(model, {key: value}, "", []) is not None:
            valid[key] = value
    return model.model_validate(valid)


def _kind(data: Mapping[str, Any], problems: list[str]) -> str:
    kind = data.get("kind")
    if kind is None:
        problems.append('kind: missing; add kind = "sweep" or kind = "continuation".')
    elif kind not in KINDS:
        problems.append(unknown_choice("kind", kind, KINDS))
    return str(kind)


def _title(data: Mapping[str, Any], problems: list[str]) -> str:
    title = data.get("title", "")
    if not isinstance(title, str):
        problems.append(f"title = {title!r}: must be a text in quotes.")
    return str(title)


def _is_table(data: Mapping[str, Any], name: str, problems: list[str]) -> bool:
    if isinstance(data.get(name, {}), dict):
        return True
    problems.append(f"{name} = {data[name]!r}: must be a table; write [{name}].")
    return False


def _validate(model: type[Table], value: Any, path: str, problems: list[str]) -> Any:
    """Return the validated table, or None after adding its problems."""
    try:
        return model.model_validate(value)
    except ValidationError as error:
        problems += problems_of(error, model, path)
        return None


def _table(data: Mapping[str, Any], name: str, model: type[Table], problems: list[str]) -> Any:
    if not _is_table(data, name, problems):
        return None
    return _validate(model, data.get(name, {}), name, problems)


def _axes(data: Mapping[str, Any], problems: list[str]) -> dict[str, Range]:
    """Return the valid axes; the others leave problems."""
    if not _is_table(data, "axes", problems):
        return {}
    axes = {n: _validate(Range, value, f"axes.{n}", problems) for n, value in data.get("axes", {}).items()}
    return {name: axis for name, axis in axes.items() if axis is not None}


def _starts(data: Mapping[str, Any], problems: list[str]) -> Starts | None:
    if "initial_conditions" not in data:
        problems.append('initial_conditions: missing; add this table with kind = "grid", "list" or "random".')
        return None
    if not _is_table(data, "initial_conditions", problems):
        return None
    table = data["initial_conditions"]
    kind = table.get("kind")
    if kind not in _STARTS:
        choices = list(_STARTS)
        problems.append(
            'initial_conditions.kind: missing; set it to "grid", "list" or "random".'
            if kind is None
            else unknown_choice("initial_conditions.kind", kind, choices)
        )
        return None
    if kind != "grid" and "refine" in table:
        problems.append(
            f'initial_conditions.refine: only a grid can be refined; drop the key, or set kind = "grid" '
            f"instead of {kind!r}."
        )
        table = {key: value for key, value in table.items() if key != "refine"}
    starts: Starts | None = _validate(_STARTS[kind], table, "initial_conditions", problems)
    return starts


def _refine_problems(kind: str, starts: Starts | None, integration: Integration | None) -> list[str]:
    """Problems with a grid's `refine`."""
    if not isinstance(starts, GridStarts) or starts.refine is None:
        return []
    stride, key = starts.refine, f"initial_conditions.refine = {starts.refine}"
    if kind == "continuation":
        return [f"{key}: branches are not refined; drop the key, or make it a sweep."]
    lengths = {name: len(axis.array()) for name, axis in starts.ranges.items()}
    if not lengths:
        return [f"{key}: there is no range to refine; give a state a range, or drop the key."]
    shortest = min(lengths, key=lengths.__getitem__)
    if lengths[shortest] < stride:
        return [
            f"{key}: must be at most {lengths[shortest]}, the points of {shortest}; lower it, or add points."
        ]
    if integration is not None:
        n_bytes = stride ** len(lengths) * integration.n_keep * len(STATES) * 8
        if n_bytes > MAX_TILE_BYTES:
            return [
                f"{key}: over {len(lengths)} ranges a task would hold {n_bytes / 1e6:.0f} MB of sections, "
                f"more than {MAX_TILE_BYTES / 1e6:.0f} MB; lower refine or integration.n_keep."
            ]
    return []


def _walk(
    kind: str, data: Mapping[str, Any], walk: Continuation | None, axes: dict[str, Range], problems: list[str]
) -> Continuation | None:
    """Check ``[continuation]`` against the kind and the axes."""
    if kind != "continuation":
        if kind == "sweep" and "continuation" in data:
            problems.append('continuation: a sweep has none; set kind = "continuation" or drop the table.')
        return None
    declared = _declared(data)
    if walk is not None and walk.path not in declared:
        known = ", ".join(declared) or "none yet"
        problems.append(
            f"continuation.path = {walk.path!r}: must be an axis (axes: {known}); "
            "add it to [axes] or set the path."
        )
    return walk


def _parameter_problems(
    table: ParametersTable, declared: tuple[str, ...], axes: dict[str, Range], complete: bool
) -> list[str]:
    """Problems with names and values of parameters, on axes and off."""
    problems = _frequency_problems(table, declared, axes, complete)
    swept = {name: axis.array() for name, axis in axes.items() if name != FREQUENCY}
    try:
        base = load_preset(table.preset)
    except ParameterError as error:
        return problems + [f"parameters.preset: {p}" for p in error.problems]
    try:
        base = table.load()
    except ParameterError as error:
        problems += [f"parameters.overrides: {p}" for p in error.problems]
    known = (*base.names, FREQUENCY)
    problems += [f"axes.{n}: {unknown_name_problem(n, known)}" for n in declared if n not in known]
    for name in table.overrides:
        if name in declared:
            problems.append(f"axes.{name}: is also in parameters.overrides; keep one of the two.")
    for name, values in swept.items():
        problems += [f"axes.{name}: {p}" for p in _axis_problems(base, name, values)]
    return problems or [f"axes: {p}" for p in _corner_problems(base, swept)]


def _frequency_problems(
    table: ParametersTable, declared: tuple[str, ...], axes: dict[str, Range], complete: bool
) -> list[str]:
    problems = []
    if FREQUENCY in declared and table.frequency_hz is not None:
        problems.append("axes.frequency_hz: is also in parameters; keep one of the two.")
    if FREQUENCY in axes:
        least = float(axes[FREQUENCY].array()[0])
        if least <= 0:
            problems.append(f"axes.frequency_hz: its least value {least!r} must be greater than 0 Hz.")
    if FREQUENCY not in declared and table.frequency_hz is None and complete:
        return ["parameters.frequency_hz: missing; set it there, or sweep it as axes.frequency_hz."]
    return problems


def _axis_problems(base: Parameters, name: str, values: np.ndarray) -> list[str]:
    if name not in base.names:
        return []
    problems: list[str] = []
    for value in dict.fromkeys((float(values.min()), float(values.max()))):
        try:
            base.replace(**{name: value})
        except ParameterError as error:
            problems += [p for p in error.problems if p not in problems]
    return problems


def _corner_problems(base: Parameters, swept: dict[str, np.ndarray]) -> list[str]:
    """Problems between parameters: bounds are intervals, so the corners of the box decide."""
    ends = [dict.fromkeys((float(v.min()), float(v.max()))) for v in swept.values()]
    for corner in itertools.product(*ends):
        try:
            base.replace(**dict(zip(swept, corner, strict=True)))
        except ParameterError as error:
            return list(error.problems)
    return []
