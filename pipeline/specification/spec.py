"""Define `Spec`, the specification of a run: read from a TOML file or built in Python, and checked as a whole.

There are two kinds: a *sweep*, in which every cell is independent, and a *continuation*, in which branches
follow a parameter path and each point starts where the previous one ended. Keys carry units. Angles in
degrees are converted once, in `pipeline.layout.cells`.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Literal, Self, TypeVar, overload

from magpend_core.models import load_model
from magpend_core.models.drift.ramps import Ramp
from magpend_core.models.model import Model, Parameters, by_method
from magpend_core.models.presets import is_file
from pipeline.motion.drifting import Drifting
from pipeline.motion.noisy import Noisy
from pipeline.motion.recorded import Recorded
from pipeline.motion.steady import Steady
from pipeline.products.extremes import EXTREMES, ExtremesOptions
from pipeline.products.lyapunov import LYAPUNOV, LyapunovOptions
from pipeline.products.product import Options
from pipeline.products.rotation import ROTATION, RotationOptions
from pipeline.specification import drift as moving
from pipeline.specification.drift import DriftTable
from pipeline.specification.files import (
    check_new_file,
    default_directory,
    find_spec,
    merged,
    nested,
    read_toml,
    specification_toml,
    toml_tables,
    write_new,
)
from pipeline.specification.models import is_model_file, is_toml_text, plain_tables, with_model_table
from pipeline.specification.noise import NoiseTable, disturbed
from pipeline.specification.parsing import TABLES, valid_tables
from pipeline.specification.problems import SpecError, shown
from pipeline.specification.recorded_drive import DriveTable, RecordedDrive, recorded
from pipeline.specification.section import SectionTable, seen_through
from pipeline.specification.starts import STATES, GridStarts, Starts
from pipeline.specification.table_methods import TableMethod, knows_its_keys
from pipeline.specification.tables import (
    AUTO,
    EXPLICIT,
    FREQUENCY,
    STIFF,
    Continuation,
    Execution,
    Integration,
    ParametersTable,
    Range,
    word_of,
)

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    Numbers = Sequence[float] | npt.NDArray[np.float64]
    Rows = Sequence[Numbers] | npt.NDArray[np.float64]

T = TypeVar("T")
Table = Mapping[str, Any]


class Checked(Generic[T]):
    """A key or table of a specification, with its type and its defaults; reading it checks the specification."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    @overload
    def __get__(self, spec: None, owner: type) -> Self: ...
    @overload
    def __get__(self, spec: Spec, owner: type) -> T: ...
    def __get__(self, spec: Spec | None, owner: type) -> Self | T:
        if spec is None:
            return self
        found: T = spec._checked[self.name]
        return found


class Spec:
    r"""A specification of a run: the tables and keys of its TOML file.

    A specification does not change: each method ``with_...`` returns a changed copy. It is checked when a key is
    read, and by `check`, `save` and `magpend.run`, which report all problems at once.

    Parameters
    ----------
    kind
        ``sweep``, in which all cells are independent, or ``continuation``, which follows branches.
    model
        Model from `magpend.model`, its equations, name, path or table; by default ``pendulum``.
    title
        What the run is, in a line.
    parameters, axes, initial_conditions, section, drive, drift, noise, continuation, integration, products, execution
        Tables as dicts with the keys of the TOML file. The methods ``with_...`` complete their keys: `with_axis` adds
        one of `axes`, and `with_start_grid`, `with_start_list` and `with_start_random` set `initial_conditions`.
    smoke
        Changes for a short run, by dotted key: ``{"integration.n_keep": 4}``.

    Attributes
    ----------
    tables : dict
        Keys and tables as they were given.

    Examples
    --------
    >>> spec = Spec("sweep", "x' = -x + A*cos(omega*t)\nA = 1.0").with_axis("A", 0.5, 1.0, 3)
    >>> spec = spec.with_parameters(omega=1.0).with_start_grid(x=(-1, 1, 4)).with_integration(n_keep=2)
    >>> spec.tables["axes"]
    {'A': {'start': 0.5, 'stop': 1.0, 'num': 3}}
    >>> spec.integration.rtol
    1e-08
    """

    kind = Checked[str]()
    title = Checked[str]()
    reference = Checked[str | Mapping[str, Any]]()
    parameters = Checked[ParametersTable]()
    axes = Checked[dict[str, Range]]()
    initial_conditions = Checked[Starts]()
    continuation = Checked[Continuation | None]()
    integration = Checked[Integration]()
    products = Checked[dict[str, Options]]()
    execution = Checked[Execution]()
    drive = Checked[DriveTable | None]()
    section = Checked[SectionTable | None]()
    drift = Checked[dict[str, DriftTable]]()
    noise = Checked[NoiseTable | None]()

    @knows_its_keys
    def __init__(
        self,
        kind: Literal["sweep", "continuation"] | str,
        model: str | Path | Table | Model | None = None,
        title: str | None = None,
        *,
        parameters: Table | None = None,
        axes: Mapping[str, Table] | None = None,
        initial_conditions: Table | None = None,
        section: Table | None = None,
        drive: Table | None = None,
        drift: Mapping[str, Table] | None = None,
        noise: Table | None = None,
        continuation: Table | None = None,
        integration: Table | None = None,
        products: Mapping[str, Table] | None = None,
        execution: Table | None = None,
        smoke: Table | None = None,
    ) -> None:
        given = {name: value for name, value in locals().items() if name != "self"}
        self._set(plain_tables(given))

    def _set(
        self, tables: Table, folder: str | Path | None = ".", text: str = "", name: str = "", is_small: bool = False
    ) -> None:
        self.tables, self._folder = dict(tables), folder
        self._text, self._name, self._is_small = text, name, is_small

    @classmethod
    def _of(cls, *args: Any) -> Self:
        made = cls.__new__(cls)
        made._set(*args)
        return made

    @classmethod
    def read(cls, source: str | Path | Table | Spec, *, smoke: bool = False) -> Self:
        """Read and check a specification.

        Parameters
        ----------
        source
            A TOML file, the name of a shipped workflow, TOML text, a dict, or a `Spec`.
        smoke
            Whether to apply the table ``[smoke]``, with which the run takes seconds.

        Raises
        ------
        SpecError
            With all problems at once; also if there is no such file, or it is not TOML.
        """
        if isinstance(source, Mapping):
            source = specification_toml(plain_tables(source))
        if isinstance(source, cls) and source._text:
            made = source
        elif isinstance(source, Spec) or is_toml_text(source):
            text = source.text if isinstance(source, Spec) else str(source)
            made = cls._of(toml_tables(text.encode(), "the specification"), Path(), text)
        else:
            path = find_spec(source)
            made = cls._of(read_toml(path), path.parent, path.read_text("utf-8"), path.stem)
        made.check()
        return made._small() if smoke and not made._is_small else made

    @classmethod
    def parse(cls, tables: Table, folder: str | Path | None = ".") -> Self:
        """Check the tables of a specification, and return it.

        Parameters
        ----------
        tables
            Tables from TOML or from `as_dict`.
        folder
            Folder that paths of files are relative to. With `pipeline.specification.models.KEPT`, for what a run keeps,
            no other file is read and nothing is imported.

        Raises
        ------
        SpecError
            With all problems at once.
        """
        made = cls._of(tables, folder)
        made.check()
        return made

    @cached_property
    def ramps(self) -> tuple[Ramp, ...]:
        """Motions of the parameters that move while the run integrates; empty if none does."""
        return moving.ramps_of(self.drift, self.axes)

    @cached_property
    def motion(self) -> Steady:
        """How the cells move: steadily, under a recorded drive, while parameters drift, or with noise."""
        if self.noise is not None:
            return Noisy(self.model, self.integration, self.noise)
        if self.drift:
            corners = moving.corners_of(self.values, self.axes, self.frequency_hz)
            return Drifting(self.model, self.integration, self.ramps, self.values, corners)
        if self.recorded is not None:
            return Recorded(self.model, self.integration, self.recorded)
        return Steady(self.model, self.integration)

    @cached_property
    def recorded(self) -> RecordedDrive | None:
        """Recorded drive that replaces the model's own drive; None without one."""
        return recorded(self.drive, [])

    @property
    def frequency_hz(self) -> float | None:
        """Drive frequency [Hz], for a recorded drive its mean frequency; None if the frequency is swept.

        For a map, and with a section by crossing, it is `Model.clock.hertz`, as in the engine.
        """
        if self.model.clock.hertz is not None:
            return self.model.clock.hertz
        return self.parameters.hertz if self.recorded is None else self.recorded.frequency_hz

    @property
    def rate(self) -> str:
        """Word in which the drive's rate is given: ``frequency_hz``, ``omega`` or ``period``."""
        return word_of(self.axes[FREQUENCY]) if FREQUENCY in self.axes else (*self.parameters.rates, FREQUENCY)[0]

    @property
    def refine(self) -> int | None:
        """Spacing n of the initial conditions that are integrated first (every n-th grid point along each axis); None
        without refinement.
        """
        starts = self.initial_conditions
        return starts.refine if isinstance(starts, GridStarts) else None

    @cached_property
    def model(self) -> Model:
        """Model that is integrated, with what the specification adds: a Poincare section, moving parameters, noise."""
        method = STIFF if self.integration.method == STIFF else EXPLICIT
        model = seen_through(by_method(load_model(self.reference), method), self.section)
        model = moving.moved(model, self.ramps, [])
        return disturbed(model, self.noise)

    @cached_property
    def values(self) -> Parameters:
        """Values of the model parameters that are not swept."""
        return self.model.load(self.parameters.chosen, **self.parameters.overrides)

    def with_smoke(self, changes: Table) -> Self:
        """Set the changes for a short run, by dotted key; ``smoke=True`` of `magpend.run` applies them."""
        return self._changed({"smoke": plain_tables(changes)})

    # ---- tables --------------------------------------------------------------------------------

    @knows_its_keys
    def with_axis(
        self,
        name: str,
        start: float | None = None,
        stop: float | None = None,
        num: int | None = None,
        step: float | None = None,
        values: Numbers | None = None,
    ) -> Self:
        """Sweep a parameter.

        Parameters
        ----------
        name
            ``frequency_hz``, ``omega`` or ``period`` of the drive, or a parameter of the model.
        start
            First value.
        stop
            Last value; with `step`, an upper bound.
        num
            Number of evenly spaced values, both ends included; 2 or more, at most 1e+07.
        step
            Spacing, instead of `num`; above 0.
        values
            All values, instead of the other keys.
        """
        keys = {"start": start, "stop": stop, "num": num, "step": step, "values": values}
        return self._replaced(f"axes.{name}", keys)

    @knows_its_keys
    def with_start_grid(
        self,
        /,
        *,
        refine: int | None = None,
        origin: Mapping[str, str] | None = None,
        states: Mapping[str, Any] | None = None,
        **named: float | tuple[float, float, int] | Numbers | Mapping[str, Any],
    ) -> Self:
        """Start on a grid of initial states.

        Parameters
        ----------
        refine
            Stride of the cells that are computed first: 2, 4, 8, 16, 32, 64.
        origin
            Expressions of the parameters by state, from which its starts are counted: ``{"x": "sqrt(a)"}``.
        states
            States whose names are keywords here, such as ``states={"refine": (-1, 1, 11)}``; or any others.
        named
            States by name; for an angle or its rate ``NAME_deg`` takes degrees. Each is a number, ``(start, stop,
            num)``, a list of values, or a table with the keys of `with_axis`. States not given are 0.
        """
        own = {"kind": "grid", "refine": refine, "origin": origin and dict(origin)}
        own["states"] = states and {k: _range(v) for k, v in states.items()}
        return self._replaced("initial_conditions", {**own, **{k: _range(v) for k, v in named.items()}})

    @knows_its_keys
    def with_start_list(
        self, points: Rows | None = None, points_deg: Rows | None = None, *, origin: Mapping[str, str] | None = None
    ) -> Self:
        """Start from a list of initial states.

        Parameters
        ----------
        points
            Rows of states in their units.
        points_deg
            Rows in degrees and degrees/s.
        origin
            Expressions of the parameters by state, from which its starts are counted: ``{"x": "sqrt(a)"}``.
        """
        own = {"kind": "list", "points": points, "points_deg": points_deg, "origin": origin and dict(origin)}
        return self._replaced("initial_conditions", own)

    @knows_its_keys
    def with_start_random(
        self,
        /,
        *,
        n: int,
        seed: int | None = None,
        sampling: Literal["sobol", "latin-hypercube"] | None = None,
        origin: Mapping[str, str] | None = None,
        states: Mapping[str, float | tuple[float, float]] | None = None,
        **named: float | tuple[float, float],
    ) -> Self:
        """Start from random initial states in a box.

        Parameters
        ----------
        n
            Number of random states; 1 or more.
        seed
            Seed of the random numbers; 0 or more.
        sampling
            ``"sobol"`` or ``"latin-hypercube"``, which cover the box evenly; by default samples are independent.
        origin
            Expressions of the parameters by state, from which its starts are counted: ``{"x": "sqrt(a)"}``.
        states
            States whose names are keywords here, such as ``states={"n": (-1, 1)}``; or any others.
        named
            States by name; for an angle or its rate ``NAME_deg`` takes degrees. Each is a number or ``(low, high)``.
        """
        own = {"kind": "random", "n": n, "seed": seed, "sampling": sampling, "origin": origin and dict(origin)}
        own["states"] = states and dict(states)
        return self._replaced("initial_conditions", {**own, **named})

    with_parameters = TableMethod(ParametersTable, "Set values of the model's parameters.")
    with_section = TableMethod(SectionTable, "Take sections where a state or an expression crosses a level.")
    with_continuation = TableMethod(Continuation, "Choose the axis that branches follow.")
    with_drive = TableMethod(DriveTable, "Replace the model's drive by a recorded one.")
    # type checkers know the key `from_` by its alias, which is no name
    with_drift: Callable[..., Spec] = TableMethod(
        DriftTable, "Move a parameter while the run integrates.", "drift.{name}", "Parameter of the model."
    )  # type: ignore[assignment]
    with_noise = TableMethod(NoiseTable, "Add white noise to equations.")
    with_integration = TableMethod(Integration, "Set tolerances, transient and kept sections.")
    with_execution = TableMethod(Execution, "Set the sizes of tasks, which change no number.")

    @knows_its_keys
    def with_products(self, **products: Table) -> Self:
        """Ask for products of every cell, by name; those that were asked for before stay.

        Parameters
        ----------
        products
            Options of each product, such as ``lyapunov={}`` or ``extremes={"quantities": ["x"]}``: the keys of
            `with_lyapunov`, `with_extremes` and `with_rotation`.
        """
        return self._of(merged(self.tables, {"products": plain_tables(products)}), self._folder)

    with_lyapunov = TableMethod(LyapunovOptions, LYAPUNOV.help, "products.lyapunov")
    with_extremes = TableMethod(ExtremesOptions, EXTREMES.help, "products.extremes")
    with_rotation = TableMethod(RotationOptions, ROTATION.help, "products.rotation")

    # ---- the whole specification -----------------------------------------------------------------

    def toml(self) -> str:
        """Return the specification as the text of a TOML file in the current folder, which makes the same run."""
        folder = self._folder or "."
        return specification_toml(_with_files(self.tables, lambda name: str(Path(folder) / name)))

    @property
    def text(self) -> str:
        """TOML text that the specification was read from; for one made in Python, `toml`."""
        return self._text or self.toml()

    @property
    def directory(self) -> Path:
        """Default run directory: ``runs/NAME`` with the name of the file, or the model's name and a digest."""
        name = self._name or f"{self.model.name}-{hashlib.sha256(self.text.encode()).hexdigest()[:8]}"
        return default_directory(Path(name), self._is_small)

    def check(self) -> None:
        """Check the specification.

        Raises
        ------
        SpecError
            If it is not valid; the message lists all problems with their key, value, bound and remedy.
        """
        self._checked  # noqa: B018

    def save(self, path: str | Path) -> Path:
        """Check the specification and write it to a TOML file, which ``magpend run`` takes; return the path.

        Names of files in it become relative to the new file's folder.

        Raises
        ------
        SpecError
            If the specification is not valid, or another text has the file's name; nothing is overwritten.
        """
        self.check()
        target, folder = check_new_file(path, [".toml"]), self._folder or "."
        text = specification_toml(_with_files(self.tables, lambda name: _seen_from(Path(folder) / name, target.parent)))
        if not (target.exists() and target.read_text("utf-8") == text):
            write_new(target, text, "path")
        return target

    def as_dict(self) -> dict[str, Any]:
        """Return the specification as plain dicts with all defaults filled in; `parse` reads them back."""
        tables: dict[str, Any] = {"kind": self.kind, "title": self.title, "model": self.reference}
        for name in TABLES:
            table = getattr(self, name)
            if table is not None:
                tables[name] = table.model_dump(mode="json", exclude_none=True)
        tables["initial_conditions"] = self.initial_conditions.plain()
        tables["products"] = {name: options.plain() for name, options in self.products.items()}
        if self.drift:
            tables["drift"] = {name: table.plain() for name, table in self.drift.items()}
        tables["axes"] = {
            self.rate if name == FREQUENCY else name: axis.model_dump(mode="json", exclude_none=True)
            for name, axis in self.axes.items()
        }
        if self.continuation is not None and self.continuation.path == FREQUENCY:
            tables["continuation"]["path"] = self.rate
        return tables

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Spec) and self.as_dict() == other.as_dict()

    def __repr__(self) -> str:
        return self.toml()

    def replace(self, **tables: Any) -> Self:
        """Return a copy with other checked tables, which are not checked together."""
        made = self._of(self.tables, self._folder)
        made.__dict__["_checked"] = {**self._checked, **tables}
        return made

    def by_method(self, method: str) -> Self:
        """Return the specification with the method that is decided for its run; the written tables stay."""
        return self.replace(integration=self.integration.model_copy(update={"method": method}))

    def keeping_method(self, kept: Spec | None) -> Self:
        """Return the specification, if it chooses no method, with the one decided for the run that keeps `kept`."""
        decided = None if kept is None else kept.integration.method
        is_open = self.integration.method == AUTO and decided in (EXPLICIT, STIFF)
        return self.by_method(decided) if is_open and decided else self

    # ---- checks and changes ------------------------------------------------------------------------

    @cached_property
    def _checked(self) -> dict[str, Any]:
        """Keys and tables with their types, by name; the table ``[smoke]`` is checked with them."""
        plain = {key: value for key, value in self.tables.items() if key != "smoke"}
        problems, found = _problems_and_tables(plain, self._folder)
        if "smoke" in self.tables:
            try:
                more, _ = _problems_and_tables(self._smoked(plain), self._folder)
                problems = problems + [f"with [smoke]: {p}" for p in more if p not in problems]
            except SpecError as error:
                problems = problems + error.problems
        if problems:
            raise SpecError(problems)
        return found

    def _smoked(self, plain: Table) -> dict[str, Any]:
        """Return the tables with the changes of ``[smoke]``."""
        table = self.tables["smoke"]
        if not isinstance(table, dict):
            raise SpecError(f"smoke = {shown(table)}: must be a table of keys to replace.")
        changes = nested(table)
        is_model = isinstance(changes.get("model"), dict) and self._folder is not None
        return merged(with_model_table(plain, self._folder or ".") if is_model else plain, changes)

    def _small(self) -> Self:
        """Return a specification for a short run: with the changes of ``[smoke]``, or with the ends of its ranges."""
        plain = {key: value for key, value in self.tables.items() if key != "smoke"}
        tables = self._smoked(plain) if "smoke" in self.tables else _ends_of_ranges(plain)
        made = self._of(tables, self._folder, self._text, self._name, True)
        made.check()
        return made

    def _changed(self, tables: Table) -> Self:
        return self._of({**self.tables, **tables}, self._folder)

    def _updated(self, path: str, keys: Table) -> Self:
        given = {key: value for key, value in keys.items() if value is not None}
        return self._of(merged(self.tables, _below(path, plain_tables(given))), self._folder)

    def _replaced(self, path: str, keys: Table) -> Self:
        given = {key: value for key, value in keys.items() if value is not None}
        outer, _, name = path.partition(".")
        table, others = plain_tables(given), self.tables.get(outer)
        kept = others if name and isinstance(others, dict) else {}
        return self._changed({outer: {**kept, name: table} if name else table})


def _problems_and_tables(tables: Table, folder: str | Path | None) -> tuple[list[str], dict[str, Any]]:
    try:
        return [], valid_tables(tables, folder)
    except SpecError as error:
        return error.problems, {}


def _ends_of_ranges(data: dict[str, Any]) -> dict[str, Any]:
    """Return a valid specification with the ends of each axis and range of states, and at most two other starts."""
    starts = dict(data["initial_conditions"])
    kind = starts.get("kind")
    if kind == "grid":
        starts.pop("refine", None)
        below = {STATES: _grid_ends(starts[STATES])} if STATES in starts else {}
        starts = {**_grid_ends(starts), **below}
    elif kind == "list":
        starts |= {key: starts[key][:2] for key in ("points", "points_deg") if key in starts}
    elif "n" in starts:
        starts["n"] = min(starts["n"], 2)
    axes = {name: _ends(axis) for name, axis in data.get("axes", {}).items()}
    return {**data, "initial_conditions": starts, **({"axes": axes} if axes else {})}


def _grid_ends(states: dict[str, Any]) -> dict[str, Any]:
    return {key: _ends(value) if isinstance(value, dict) and key != STATES else value for key, value in states.items()}


def _ends(values: dict[str, Any]) -> dict[str, Any]:
    if "values" in values:
        return {"values": [values["values"][0], *values["values"][1:][-1:]]}
    return {"start": values["start"], "stop": values["stop"], "num": 2}


def _below(path: str, table: Table) -> dict[str, Any]:
    outer, _, name = path.partition(".")
    return {outer: {name: table} if name else table}


def _range(value: Any) -> Any:
    """Return the table of a range given as ``(start, stop, num)`` or as a list of values; other values unchanged."""
    if isinstance(value, tuple) and len(value) == 3:
        return dict(zip(("start", "stop", "num"), value, strict=True))
    if isinstance(value, str | Mapping) or not hasattr(value, "__len__"):
        return value
    return {"values": value}


def _with_files(tables: Table, name_of: Callable[[str], str]) -> dict[str, Any]:
    """Return tables with new names for the files that they refer to: the model, a preset, recordings."""
    result = dict(tables)
    if is_model_file(tables.get("model")):
        result["model"] = name_of(tables["model"])
    preset = tables.get("parameters", {}).get("preset") if isinstance(tables.get("parameters"), dict) else None
    if isinstance(preset, str) and is_file(preset):
        result["parameters"] = {**tables["parameters"], "preset": name_of(preset)}
    for key in ("drive", "drift"):
        result |= {key: _with_file(tables[key], name_of)} if key in tables else {}
    return result


def _with_file(table: Any, name_of: Callable[[str], str]) -> Any:
    if not isinstance(table, Mapping):
        return table
    found = {key: _with_file(value, name_of) for key, value in table.items()}
    if isinstance(table.get("file"), str):
        found["file"] = name_of(table["file"])
    return found


def _seen_from(path: Path, folder: Path) -> str:
    return str(path) if path.is_absolute() else os.path.relpath(path, folder)
