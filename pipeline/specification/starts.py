"""Define the tables of initial conditions: grids, lists and random samples of a model's states.

Keys are the names of the states. Angles and their rates can be given in degrees, with ``_deg`` after the
name. The pydantic model of each table is created for each `Model`.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from functools import lru_cache
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BaseModel, Discriminator, Field, Tag, create_model, model_validator

from magpend_core.models.model import Model
from magpend_core.models.text.keys import read_key
from pipeline.specification.expressions import read_expression
from pipeline.specification.problems import shown, unknown_name
from pipeline.specification.tables import MAX_POINTS, Integration, Range, Table

STATES = "states"
"""Key of the table of states below the table of initial conditions."""

BELOW = f"{STATES}."
"""Beginning of the aliases of its entries."""

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
    """Base class of tables with a value or range per state; `starts_model` adds the fields.

    A state's key stands beside the table's own keys, or in the table ``states`` below it: there under any name, so that
    a state may be called as one of the table's own keys. Fields have neutral names, and the keys as aliases.
    """

    system: ClassVar[Model]
    origin: Origin
    fields_by_key: ClassVar[Mapping[str, str]] = {}  # fields of the states, by state key
    own_keys: ClassVar[tuple[str, ...]] = ()  # keys of the table that set no state

    @model_validator(mode="before")
    @classmethod
    def _flat(cls, table: Any) -> Any:
        """Move the entries of the table ``states`` to their aliases."""
        if not isinstance(table, Mapping):
            return table
        table = _elements(table)
        below = table.get(STATES)
        if below is None:
            return table
        if not isinstance(below, Mapping):
            raise ValueError(f"{STATES} = {shown(below)}: must be a table of states, such as {STATES} = {{x = 0.5}}.")
        if twice := [key for key in below if key in table and key not in cls.own_keys]:
            raise ValueError(f"{twice[0]} and {STATES}.{twice[0]} are both given; keep one.")
        beside = {key: value for key, value in table.items() if key != STATES}
        return beside | {alias_of(key, cls.own_keys, cls.fields_by_key): v for key, v in _elements(below).items()}

    @model_validator(mode="after")
    def _one_unit(self) -> _PerState:
        _check_origin(self.origin, self.system)
        given = self.given
        for name in self.system.state_names:
            if name in given and degrees_key(name) in given and degrees_key(name) not in self.system.state_names:
                raise ValueError(f"{name} and {degrees_key(name)} are both given; keep one.")
        return self

    @property
    def given(self) -> dict[str, Any]:
        """Values that are given, by state key: the name of a state, or the name with ``_deg``."""
        values = {key: getattr(self, field) for key, field in self.fields_by_key.items()}
        return {key: value for key, value in values.items() if value is not None}

    def of(self, key: str) -> Any:
        """Return the value given for a state key, such as ``x`` or ``x_deg``; None if it is not given."""
        return self.given.get(key)

    def plain(self) -> dict[str, Any]:
        """Return the table as plain values, as it stands in a specification."""
        found = self.model_dump(mode="json", exclude_none=True, by_alias=True)
        own = {key: value for key, value in found.items() if not key.startswith(BELOW)}
        below = {key.removeprefix(BELOW): value for key, value in found.items() if key.startswith(BELOW)}
        return {**own, **({STATES: below} if below else {})}


def _elements(table: Mapping[Any, Any]) -> dict[Any, Any]:
    """Return a table with an entry for each state that a key such as ``x[1..20]`` stands for."""
    several = {key: read_key(key) for key in table if isinstance(key, str) and "[" in key}
    return {
        name: value
        for key, value in table.items()
        for name, _ in (several[key].elements if key in several else [(key, None)])
    }


def alias_of(key: str, own: Sequence[str], known: Container[str] = ()) -> str:
    """Return the alias of a state's key in the table of initial conditions: below `STATES` if a key of the table has
    the name, or if the key is not known.
    """
    return key if key in known and key not in own else BELOW + key


def put_start(table: dict[str, Any], key: str, value: Any, starts: GridStarts | RandomStarts) -> None:
    """Set the value or range of a state in the plain table of initial conditions, in place of what it has of this
    state.
    """
    below = dict(table.pop(STATES, {}))
    state = state_of_key(key, starts.system)
    for name in [one for one in state_keys(starts.system) if state_of_key(one, starts.system) == state]:
        below.pop(name, None)
        if name not in starts.own_keys:
            table.pop(name, None)
    (below if key in starts.own_keys else table)[key] = value
    if below:
        table[STATES] = below


Origin = Annotated[
    dict[str, str] | None,
    Field(
        None,
        description="Expressions of the parameters (and f, pi) by state, from which its starts are counted: "
        '`origin = {x = "sqrt(a)"}`.',
    ),
]
"""Field of the tables of initial conditions with starts that depend on parameters."""


def _check_origin(origin: Mapping[str, str] | None, model: Model) -> None:
    """Raise ValueError unless each expression is one of parameters, of a state of the model."""
    for state, text in (origin or {}).items():
        if state not in model.state_names:
            raise ValueError(f"origin: {unknown_name('state', state, model.state_names)}")
        read_expression(f"origin.{state}", text, model.parameter_names)


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
        return {key: value for key, value in self.given.items() if isinstance(value, Range)}


class ListStarts(Table):
    """The table ``[initial_conditions]`` of kind list: rows of states in the model's order.

    Rows may leave out the rates at the end of the state; the rates are then 0.
    """

    system: ClassVar[Model]

    kind: Literal["list"]
    points: Rows | None = Field(None, description="Rows of states in their units.")
    points_deg: Rows | None = Field(None, description="Rows in degrees and degrees/s.")
    origin: Origin

    @model_validator(mode="after")
    def _rows(self) -> ListStarts:
        _check_origin(self.origin, self.system)
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

    def plain(self) -> dict[str, Any]:
        """Return the table as plain values, as it stands in a specification."""
        return self.model_dump(mode="json", exclude_none=True)


def positions(model: Model) -> tuple[str, ...]:
    """Return the names of the states before the velocities. A row in a list of initial conditions may give these states
    only.
    """
    rates = {s.rate for s in model.states if s.rate}
    names = model.state_names
    first = next((i for i, name in enumerate(names) if name in rates), len(names))
    return names[:first] if set(names[first:]) <= rates else names


class RandomStarts(_PerState):
    """The table ``[initial_conditions]`` of kind random: uniform samples from a box ``[low, high]`` per state.

    With `sampling` they cover it more evenly than independent ones.
    """

    kind: Literal["random"]
    n: int = Field(ge=1, le=MAX_POINTS, description="Number of samples.")
    seed: int = Field(0, ge=0, description="Seed of the samples.")
    sampling: Literal["sobol", "latin-hypercube"] | None = Field(
        None, description="sobol or latin-hypercube cover the box evenly; without it samples are independent."
    )

    @model_validator(mode="after")
    def _boxes(self) -> RandomStarts:
        for key, value in self.given.items():
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
    keys = () if annotation is None else state_keys(model)
    own = (*base.model_fields, STATES)
    fields: Any = {f"state_{i}": (annotation, Field(None, alias=alias_of(k, own, keys))) for i, k in enumerate(keys)}
    made: type[Starts] = create_model(base.__name__, __base__=base, __module__=__name__, **fields)
    made.system = model
    if issubclass(made, _PerState):
        made.fields_by_key, made.own_keys = dict(zip(keys, fields, strict=True)), own
    return made


def start_remarks(starts: Starts) -> list[str]:
    """Return a line that names the states whose start is not given, with the start taken; empty if all are given."""
    states, own = starts.system.states, () if isinstance(starts, ListStarts) else starts.own_keys
    if isinstance(starts, ListStarts):
        left = states[min(map(len, starts.points or starts.points_deg or ())) :]
    else:
        given = {state_of_key(key, starts.system) for key in starts.given}
        left = tuple(state for state in states if state.name not in given)
    taken = ", ".join(f"{state.name} = 0 {state.unit}".rstrip() for state in left)
    hidden = "".join(f"; {state_below(state.name)}" for state in left if state.name in own)
    return [f"starts not given, so taken as 0: {taken} (set in initial_conditions{hidden})"] if left else []


def state_below(name: str) -> str:
    """Say where a state is given whose name is that of a key of the table of initial conditions."""
    return f"the state {name} in its table {STATES} = {{{name} = ...}}"


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
