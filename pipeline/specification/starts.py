"""Define the tables of initial conditions: grids, lists and random samples of a model's states.

Keys are the names of the states. Angles and their rates can be given in degrees, with ``_deg`` after the
name. The pydantic model of each table is created for each `Model`.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BaseModel, Discriminator, Field, Tag, create_model, model_validator

from magpend_core.models.model import Model
from pipeline.specification.tables import MAX_POINTS, Integration, Range, Table

STRIDES = (2, 4, 8, 16, 32, 64)
IN_DEGREES = ("rad", "rad/s")
"""Units of states that can also be given in degrees."""
MAX_TILE_BYTES = 256_000_000
"""Most bytes of sections in the smallest tile of a refined grid."""


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
    Annotated[float, Tag("(number)")] | Annotated[tuple[float, float], Field(strict=False), Tag("(interval)")],
    Discriminator(_number_or_interval),
]
Rows = Annotated[tuple[Annotated[tuple[float, ...], Field(strict=False)], ...], Field(strict=False, min_length=1)]


def degrees_key(state: str) -> str:
    """Return the key that gives a state in degrees: its name with ``_deg``."""
    return f"{state}_deg"


def state_keys(model: Model) -> tuple[str, ...]:
    """Return all keys that set a state: its name and, for angles and their rates, the name with ``_deg``."""
    return tuple(
        key for s in model.states for key in ((s.name, degrees_key(s.name)) if s.unit in IN_DEGREES else (s.name,))
    )


def state_of_key(key: str, model: Model) -> str | None:
    """Return the state that a key such as ``x`` or ``x_deg`` sets; None if it sets none."""
    if key not in state_keys(model):
        return None
    return key if key in model.state_names else key.removesuffix(degrees_key(""))


class _PerState(Table):
    """Base class of tables with a value or range per state; `starts_model` adds the fields."""

    system: ClassVar[Model]

    @model_validator(mode="after")
    def _one_unit(self) -> _PerState:
        for name in self.system.state_names:
            if self.of(name) is not None and getattr(self, degrees_key(name), None) is not None:
                raise ValueError(f"{name} and {degrees_key(name)} are both given; keep one.")
        return self

    def of(self, key: str) -> Any:
        """Return the value given for a state key, such as ``x`` or ``x_deg``; None if it is not given."""
        return getattr(self, key, None)


def _power_of_two(stride: int) -> int:
    if stride not in STRIDES:
        raise ValueError(f"{stride} is not among {', '.join(map(str, STRIDES))}; take one of these.")
    return stride


class GridStarts(_PerState):
    """The table ``[initial_conditions]`` of kind grid: a range or a fixed number per state; states not given are 0.

    With `refine` a sweep computes every `refine`-th cell first; see `pipeline.compute.refinement`.
    """

    nested_model: ClassVar[type[BaseModel] | None] = Range

    kind: Literal["grid"]
    refine: Annotated[int, AfterValidator(_power_of_two)] | None = Field(
        None, description=f"Stride of the cells that are computed first: {', '.join(map(str, STRIDES))}."
    )

    @property
    def ranges(self) -> dict[str, Range]:
        """Ranges that span the grid, by state key (the name of a state, or the name with ``_deg``)."""
        return {key: value for key, value in self if isinstance(value, Range)}


class ListStarts(Table):
    """The table ``[initial_conditions]`` of kind list: rows of states in the model's order.

    Rows may leave out the rates at the end of the state; the rates are then 0.
    """

    system: ClassVar[Model]

    kind: Literal["list"]
    points: Rows | None = Field(None, description="Rows of states in their units.")
    points_deg: Rows | None = Field(None, description="Rows in degrees and degrees/s.")

    @model_validator(mode="after")
    def _rows(self) -> ListStarts:
        names = self.system.state_names
        degrees = all(s.unit in IN_DEGREES for s in self.system.states)
        if self.points_deg is not None and not degrees:
            raise ValueError(f"points_deg: not all of {', '.join(names)} are angles; give points.")
        if (self.points is None) == (self.points_deg is None):
            both = "points (rad, rad/s) or points_deg (degrees, degrees/s), one of them" if degrees else "points"
            raise ValueError(f"give {both}.")
        lengths = sorted({len(positions(self.system)), len(names)})
        for i, row in enumerate(self.points or self.points_deg or ()):
            if len(row) not in lengths:
                wanted = " or ".join(", ".join(names[:n]) for n in lengths)
                raise ValueError(f"row {i} has {len(row)} numbers; give {wanted}.")
        return self


def positions(model: Model) -> tuple[str, ...]:
    """Return the names of the states before the velocities. A row in a list of initial conditions may give these states
    only.
    """
    rates = {s.rate for s in model.states if s.rate}
    names = model.state_names
    first = next((i for i, name in enumerate(names) if name in rates), len(names))
    return names[:first] if set(names[first:]) <= rates else names


class RandomStarts(_PerState):
    """The table ``[initial_conditions]`` of kind random: uniform samples from a box ``[low, high]`` per state."""

    kind: Literal["random"]
    n: int = Field(ge=1, le=MAX_POINTS, description="Number of samples.")
    seed: int = Field(0, ge=0, description="Seed of the samples.")

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
STARTS: dict[str, type[Starts]] = {"grid": GridStarts, "list": ListStarts, "random": RandomStarts}


@lru_cache(maxsize=64)
def starts_model(kind: str, model: Model) -> type[Starts]:
    """Create the class of the table ``[initial_conditions]``, with fields for each state of a model.

    Parameters
    ----------
    kind
        ``"grid"``, ``"list"`` or ``"random"``.
    model
        Model that has the states.
    """
    base = STARTS[kind]
    annotation: Any = {"grid": Extent | None, "random": Interval | None}.get(kind)
    fields: Any = {} if annotation is None else dict.fromkeys(state_keys(model), (annotation, None))
    made: type[Starts] = create_model(base.__name__, __base__=base, __module__=__name__, **fields)
    made.system = model
    return made


def start_remarks(starts: Starts) -> list[str]:
    """Return a line that names the states whose start is not given, with the start taken; empty if all are given."""
    states = starts.system.states
    if isinstance(starts, ListStarts):
        left = states[min(map(len, starts.points or starts.points_deg or ())) :]
    else:
        given = {state_of_key(key, starts.system) for key, value in starts if value is not None}
        left = tuple(state for state in states if state.name not in given)
    taken = ", ".join(f"{state.name} = 0 {state.unit}".rstrip() for state in left)
    return [f"starts not given, so taken as 0: {taken} (set in initial_conditions)"] if left else []


def refine_problems(kind: str, starts: Starts | None, integration: Integration | None, model: Model) -> list[str]:
    """Return the problems of `refine` on a grid of initial conditions: ranges too short, a continuation, too much
    memory.
    """
    if not isinstance(starts, GridStarts) or starts.refine is None:
        return []
    stride, key = starts.refine, f"initial_conditions.refine = {starts.refine}"
    if kind == "continuation":
        return [f'{key}: a continuation cannot be refined; drop the key, or set kind = "sweep".']
    lengths = {name: len(axis.array()) for name, axis in starts.ranges.items()}
    if not lengths:
        return [f"{key}: there is no range to refine; give a state a range, or drop the key."]
    shortest = min(lengths, key=lengths.__getitem__)
    if lengths[shortest] < stride:
        return [f"{key}: must be at most {lengths[shortest]}, the points of {shortest}; lower it, or add points."]
    if integration is not None:
        n_bytes = stride ** len(lengths) * integration.n_keep * len(model.states) * 8
        if n_bytes > MAX_TILE_BYTES:
            return [
                f"{key}: over {len(lengths)} ranges a task would hold {n_bytes / 1e6:.0f} MB of sections, "
                f"more than {MAX_TILE_BYTES / 1e6:.0f} MB; lower refine or integration.n_keep."
            ]
    return []
