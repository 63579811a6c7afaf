"""Build the specification of a run in Python: `Spec`, with a method for each table."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

from magpend_core.models.presets import is_file
from pipeline.layout.domains import check_starts
from pipeline.products.extremes import EXTREMES, ExtremesOptions
from pipeline.products.lyapunov import LYAPUNOV, LyapunovOptions
from pipeline.products.rotation import ROTATION, RotationOptions
from pipeline.runs.arguments import knows_its_keys, names_arguments
from pipeline.runs.table_methods import TableMethod
from pipeline.runs.workflows import find_spec, read_given
from pipeline.specification.drift import DriftTable
from pipeline.specification.files import check_new_file, merged, read_toml, toml_tables, write_new
from pipeline.specification.inputs import is_toml_text, plain_tables
from pipeline.specification.models import is_model_file
from pipeline.specification.noise import NoiseTable
from pipeline.specification.recorded_drive import DriveTable
from pipeline.specification.section import SectionTable
from pipeline.specification.tables import Continuation, Execution, Integration, ParametersTable
from pipeline.specification.writing import specification_toml

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from magpend_core.models.model import Model
    from pipeline.runs.preview import Preview

__all__ = ["Spec"]

Table = Mapping[str, Any]
if TYPE_CHECKING:
    Numbers = Sequence[float] | npt.NDArray[np.float64]
    Rows = Sequence[Numbers] | npt.NDArray[np.float64]


class Spec(Mapping[str, Any]):
    r"""A specification of a run, built in Python; a mapping with the tables and keys of the TOML file.

    A specification does not change: each method returns a changed copy. Nothing is checked before `check`,
    `preview`, `save` or `magpend.run`, which report all problems at once.

    Parameters
    ----------
    kind
        ``sweep``, in which all cells are independent, or ``continuation``, which follows branches.
    model
        Model from `magpend.model`, its equations, name, path or table; by default ``pendulum``.
    title
        What the run is, in a line.
    parameters, axes, initial_conditions, section, drive, drift, noise, continuation, integration, products, execution
        Tables as dicts with the keys of the TOML file. The methods of the same names complete their keys:
        `axis` adds one of `axes`, and `start_grid`, `start_list` and `start_random` set `initial_conditions`.
    smoke
        Changes for a short run, by dotted key: ``{"integration.n_keep": 4}``.

    Examples
    --------
    >>> spec = Spec("sweep", "x' = -x + A*cos(2*pi*f*t)\nA = 1.0").axis("A", 0.5, 1.0, 3)
    >>> spec = spec.parameters(frequency_hz=0.2).start_grid(x=(-1, 1, 4)).integration(n_keep=2)
    >>> spec["axes"]
    {'A': {'start': 0.5, 'stop': 1.0, 'num': 3}}
    """

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
        given = {
            "kind": kind,
            "title": title,
            "parameters": parameters,
            "axes": axes,
            "initial_conditions": initial_conditions,
            "section": section,
            "drive": drive,
            "drift": drift,
            "noise": noise,
            "continuation": continuation,
            "integration": integration,
            "products": products,
            "execution": execution,
            "smoke": smoke,
            "model": model,
        }
        self._tables = plain_tables(given)

    @classmethod
    def read(cls, spec: str | Path | Table) -> Self:
        """Return a specification from a TOML file, the name of a shipped workflow, TOML text or a dict.

        Raises
        ------
        SpecError
            If there is no such file, or it is not TOML. The content is not checked.
        """
        if isinstance(spec, Mapping):
            return cls._of(plain_tables(spec))
        if is_toml_text(spec):
            return cls._of(toml_tables(str(spec).encode(), "the specification"))
        path = find_spec(spec)
        return cls._of(_moved(read_toml(path), lambda name: str(path.parent / name)))

    @classmethod
    def _of(cls, tables: Table) -> Self:
        made = cls.__new__(cls)
        made._tables = dict(tables)
        return made

    def smoke(self, changes: Table) -> Self:
        """Set the changes for a short run, by dotted key; ``smoke=True`` of `magpend.run` applies them."""
        return self._of({**self._tables, "smoke": plain_tables(changes)})

    # ---- tables --------------------------------------------------------------------------------

    @knows_its_keys
    def axis(
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
            ``frequency_hz`` or a parameter of the model.
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
    def start_grid(
        self, *, refine: int | None = None, **states: float | tuple[float, float, int] | Numbers | Mapping[str, Any]
    ) -> Self:
        """Start on a grid of initial states.

        Parameters
        ----------
        refine
            Stride of the cells that are computed first: 2, 4, 8, 16, 32, 64.
        states
            States by name; for an angle or its rate ``NAME_deg`` takes degrees. Each is a number, ``(start, stop,
            num)``, a list of values, or a table with the keys of `axis`. States not given are 0.
        """
        return self._replaced("initial_conditions", {"kind": "grid", "refine": refine, **states})

    @knows_its_keys
    def start_list(self, points: Rows | None = None, points_deg: Rows | None = None) -> Self:
        """Start from a list of initial states.

        Parameters
        ----------
        points
            Rows of states in their units.
        points_deg
            Rows in degrees and degrees/s.
        """
        return self._replaced("initial_conditions", {"kind": "list", "points": points, "points_deg": points_deg})

    @knows_its_keys
    def start_random(self, *, n: int, seed: int | None = None, **states: float | tuple[float, float]) -> Self:
        """Start from random initial states in a box.

        Parameters
        ----------
        n
            Number of random states; 1 or more.
        seed
            Seed of the random numbers; 0 or more.
        states
            States by name; for an angle or its rate ``NAME_deg`` takes degrees. Each is a number or ``(low, high)``.
        """
        return self._replaced("initial_conditions", {"kind": "random", "n": n, "seed": seed, **states})

    parameters = TableMethod(ParametersTable, "Set values of the model's parameters.")
    section = TableMethod(SectionTable, "Take sections where a state crosses a level.")
    continuation = TableMethod(Continuation, "Choose the axis that branches follow.")
    drive = TableMethod(DriveTable, "Replace the model's drive by a recorded one.")
    # type checkers know the key `from_` by its alias, which is no name
    drift: Callable[..., Spec] = TableMethod(
        DriftTable, "Move a parameter while the run integrates.", "drift.{name}", "Parameter of the model."
    )  # type: ignore[assignment]
    noise = TableMethod(NoiseTable, "Add white noise to equations.")
    integration = TableMethod(Integration, "Set tolerances, transient and kept sections.")
    execution = TableMethod(Execution, "Set the sizes of tasks, which change no number.")
    lyapunov = TableMethod(LyapunovOptions, LYAPUNOV.help, "products.lyapunov")
    extremes = TableMethod(ExtremesOptions, EXTREMES.help, "products.extremes")
    rotation = TableMethod(RotationOptions, ROTATION.help, "products.rotation")

    def toml(self) -> str:
        """Return the specification as the text of a TOML file, which makes the same run."""
        return specification_toml(self._tables)

    @names_arguments
    def check(self, *, smoke: bool = False) -> None:
        """Check the specification as `magpend.run` does before it computes.

        Raises
        ------
        SpecError
            If it is not valid; the message lists all problems with their key, value, bound and remedy.
        """
        check_starts(read_given(self, smoke=smoke)[0])

    @names_arguments
    def preview(self, out: str | Path | None = None, *, workers: int | None = None, smoke: bool = False) -> Preview:
        """Describe the run: cells, bytes, time.

        Nothing is created. The time is measured on some of the run's own cells when the description is shown,
        or when its `times` are first read, which takes seconds.

        Parameters
        ----------
        out, workers, smoke
            As for `magpend.run`.

        Raises
        ------
        SpecError, RefusedError
            If the specification is not valid, or the directory has another run.
        """
        from pipeline.runs.preview import preview

        return preview(self, out, workers=workers, smoke=smoke)

    def save(self, path: str | Path) -> Path:
        """Check the specification and write it to a TOML file, which ``magpend run`` takes; return the path.

        Names of files in it become relative to the new file's folder.

        Raises
        ------
        SpecError
            If the specification is not valid, or another text has the file's name; nothing is overwritten.
        """
        self.check()
        target = check_new_file(path, [".toml"])
        text = specification_toml(_moved(self._tables, lambda name: _seen_from(name, target.parent)))
        if not (target.exists() and target.read_text("utf-8") == text):
            write_new(target, text, "path")
        return target

    def __getitem__(self, key: str) -> Any:
        return self._tables[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._tables)

    def __len__(self) -> int:
        return len(self._tables)

    def __repr__(self) -> str:
        return self.toml()

    def _updated(self, path: str, keys: Table) -> Self:
        given = {key: value for key, value in keys.items() if value is not None}
        return self._of(merged(self._tables, _below(path, plain_tables(given))))

    def _replaced(self, path: str, keys: Table) -> Self:
        is_grid = keys.get("kind") == "grid"
        given = {key: _range(value) if is_grid else value for key, value in keys.items() if value is not None}
        outer, _, name = path.partition(".")
        table, others = plain_tables(given), self._tables.get(outer)
        kept = others if name and isinstance(others, dict) else {}
        return self._of({**self._tables, outer: {**kept, name: table} if name else table})


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


def _moved(tables: Table, name_of: Callable[[str], str]) -> dict[str, Any]:
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


def _seen_from(name: str, folder: Path) -> str:
    return name if Path(name).is_absolute() else os.path.relpath(name, folder)
