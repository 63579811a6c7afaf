"""Write the module `pipeline.runs.spec_tables` from the tables of a specification: a method for each, with its keys.

The methods have explicit signatures, so that editors and notebooks complete the keys and mypy checks them.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel

from pipeline.cli.reference_words import bounds_in_words, default_in_words
from pipeline.products.registry import CELL_PRODUCTS
from pipeline.specification import drift, noise, recorded_drive, section, starts, tables

MODULE = Path(__file__).parents[1] / "runs" / "spec_tables.py"
_FILLED_IN = ("kind", "sha256", "text")
"""Keys that are not given by hand."""

_HEAD = '''"""Methods of `magpend.Spec`, one for each table of a specification.

Made by ``python -m pipeline.cli.reference``; change `pipeline.cli.reference_spec` instead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, Self

from pipeline.runs.arguments import knows_its_keys

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    Numbers = Sequence[float] | npt.NDArray[np.float64]
    Rows = Sequence[Numbers] | npt.NDArray[np.float64]


class SpecTables:
    """Base class of `magpend.Spec` with a method for each table. Each method returns a changed copy."""

    def _updated(self, path: str, keys: Mapping[str, Any]) -> Self:
        raise NotImplementedError

    def _replaced(self, path: str, keys: Mapping[str, Any]) -> Self:
        raise NotImplementedError
'''
WIDTH = 120


@dataclass(frozen=True)
class Method:
    """A method to write: its name, the table that it sets, and what is special in its signature.

    Attributes
    ----------
    path : str
        Path of the table; ``{name}`` in it becomes a first argument of that name.
    summary : str
        First line of the docstring.
    model : type of BaseModel
        The table.
    positional : bool
        Whether keys may be given in their order.
    fixed : tuple of (str, str)
        Key and value that the method itself sets.
    states : tuple of (str, str)
        Type and description of keywords that are states of the model.
    argument : str
        Description of a first argument ``name``, if the path has one.
    """

    name: str
    path: str
    summary: str
    model: type[BaseModel]
    positional: bool = False
    fixed: tuple[str, str] | None = None
    states: tuple[str, str] | None = None
    argument: str = ""

    @property
    def replaces(self) -> bool:
        """Whether a call replaces the table; else it changes the given keys."""
        has_required = any(info.is_required() for key, info in self.model.model_fields.items() if key != "kind")
        return bool(self.argument or self.fixed) or has_required


_DEGREES = "States by name; for an angle or its rate ``NAME_deg`` takes degrees. "
METHODS = (
    Method("parameters", "parameters", "Set values of the model's parameters.", tables.ParametersTable),
    Method(
        "axis",
        "axes.{name}",
        "Sweep a parameter.",
        tables.Range,
        positional=True,
        argument="``frequency_hz`` or a parameter of the model.",
    ),
    Method(
        "start_grid",
        "initial_conditions",
        "Start on a grid of initial states.",
        starts.GridStarts,
        fixed=("kind", "grid"),
        states=(
            "float | tuple[float, float, int] | Numbers | Mapping[str, Any]",
            f"{_DEGREES}Each is a number, ``(start, stop, num)``, a list of values, or a table with the keys of `axis`."
            " States not given are 0.",
        ),
    ),
    Method(
        "start_list",
        "initial_conditions",
        "Start from a list of initial states.",
        starts.ListStarts,
        fixed=("kind", "list"),
        positional=True,
    ),
    Method(
        "start_random",
        "initial_conditions",
        "Start from random initial states in a box.",
        starts.RandomStarts,
        fixed=("kind", "random"),
        states=("float | tuple[float, float]", f"{_DEGREES}Each is a number or ``(low, high)``."),
    ),
    Method("section", "section", "Take sections where a state crosses a level.", section.SectionTable),
    Method("continuation", "continuation", "Choose the axis that branches follow.", tables.Continuation),
    Method("drive", "drive", "Replace the model's drive by a recorded one.", recorded_drive.DriveTable),
    Method(
        "drift",
        "drift.{name}",
        "Move a parameter while the run integrates.",
        drift.DriftTable,
        argument="Parameter of the model.",
    ),
    Method("noise", "noise", "Add white noise to equations.", noise.NoiseTable),
    Method("integration", "integration", "Set tolerances, transient and kept sections.", tables.Integration),
    Method("execution", "execution", "Set the sizes of tasks, which change no number.", tables.Execution),
)


def module() -> str:
    """Return the text of the module."""
    of_products = (
        Method(name, f"products.{name}", f"Compute a product of every cell.\n\n        {product.help}", product.options)
        for name, product in CELL_PRODUCTS.items()
    )
    return _HEAD + "".join(f"\n{_method(method)}" for method in (*METHODS, *of_products))


def _method(method: Method) -> str:
    fields = {k: i for k, i in method.model.model_fields.items() if k not in _FILLED_IN}
    required = {name: info for name, info in fields.items() if info.is_required()}
    fields = {**required, **fields}
    arguments = ["self"] + (["name: str"] if method.argument else [])
    arguments += [] if method.positional else ["*"]
    default = {name: "" if name in required else " | None = None" for name in fields}
    arguments += [f"{name}: {_type(info.annotation)}{default[name]}" for name, info in fields.items()]
    notes = [("name", method.argument)] if method.argument else []
    notes += [(name, _note(info, name in required)) for name, info in fields.items()]
    if method.states is not None:
        arguments.append(f"**states: {method.states[0]}")
        notes.append(("states", method.states[1]))
    keys = [f'"kind": "{method.fixed[1]}"'] if method.fixed is not None else []
    keys += [f'"{info.alias or name}": {name}' for name, info in fields.items()]
    keys += ["**states"] if method.states is not None else []
    path = f'f"{method.path}"' if "{" in method.path else f'"{method.path}"'
    call = _call(f"return self.{'_replaced' if method.replaces else '_updated'}", path, keys)
    return "    @knows_its_keys\n" + _signature(method.name, arguments) + _docstring(method.summary, notes) + call


def _signature(name: str, arguments: Sequence[str]) -> str:
    """Return the head of a method as ruff formats it: on one line, with its arguments on one, or each on its own."""
    inside = ", ".join(arguments)
    if len(line := f"    def {name}({inside}) -> Self:") <= WIDTH:
        return f"{line}\n"
    if len(inside) + 8 > WIDTH:
        inside = ",\n        ".join([*arguments, ""]).rstrip(" \n")
    return f"    def {name}(\n        {inside}\n    ) -> Self:\n"


def _call(function: str, path: str, keys: Sequence[str]) -> str:
    """Return the call of a method's body as ruff formats it."""
    table = "{" + ", ".join(keys) + "}"
    if len(line := f"        {function}({path}, {table})") <= WIDTH:
        return f"{line}\n"
    if len(line := f"            {path}, {table}") <= WIDTH:
        return f"        {function}(\n{line}\n        )\n"
    if len(table) + 13 > WIDTH:
        table = "{\n" + "".join(f"                {key},\n" for key in keys) + "            }"
    return f"        {function}(\n            {path},\n            {table},\n        )\n"


def _docstring(summary: str, notes: Sequence[tuple[str, str]]) -> str:
    lines = [f'        """{summary}', "", "        Parameters", "        ----------"]
    for name, note in notes:
        lines.append(f"        {name}")
        lines += textwrap.wrap(note, 120, initial_indent=" " * 12, subsequent_indent=" " * 12)
    return "\n".join([*lines, '        """', ""])


def _note(info: Any, required: bool) -> str:
    extra: Any = info.json_schema_extra or {}
    unit = f" [{extra['unit']}]" if extra.get("unit") else ""
    words = [(info.description or "").rstrip(".") + unit, "" if "`" in bounds_in_words(info) else bounds_in_words(info)]
    default = "" if required else default_in_words(info).strip("`")
    words += [f"default {default}" if default not in ("", "()") else ""]
    return "; ".join(word for word in words if word) + "."


def _type(annotation: Any) -> str:
    """Return the source text of the type that an argument for a field has."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _type(inner[0])
    if origin in (Union, UnionType):
        return " | ".join(dict.fromkeys(_type(part) for part in inner if part is not NoneType))
    if origin is Literal:
        return f"Literal[{', '.join(repr(choice) for choice in inner)}]".replace("'", '"')
    if origin is tuple:
        return {"float": "Numbers", "Numbers": "Rows"}.get(_type(inner[0]), f"Sequence[{_type(inner[0])}]")
    if origin is dict:
        return f"Mapping[{_type(inner[0])}, {_type(inner[1])}]"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "Mapping[str, Any]"
    return str(annotation.__name__)
