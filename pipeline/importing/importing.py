"""Import the model in the file of another program as a specification that runs."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from magpend_core.models import load_model
from magpend_core.models.model import ModelError
from magpend_core.models.text.model import TextModel
from pipeline.importing.assembly import Assembled, assembled, plain
from pipeline.importing.first_run import first_tables
from pipeline.importing.source import Source
from pipeline.layout.evaluation import check_starts
from pipeline.specification.files import check_new_file, toml_key, toml_value, write_new
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from pipeline.store.local import refuse_place

READERS = {
    ".ode": "pipeline.importing.xpp:read",
    ".m": "pipeline.importing.matlab:read",
    **dict.fromkeys((".f90", ".f"), "pipeline.importing.auto:read_fortran"),
    ".c": "pipeline.importing.auto:read_c",
    **dict.fromkeys((".xml", ".sbml"), "pipeline.importing.sbml:read"),
}
"""Function that reads the files of a suffix."""


@dataclass(frozen=True)
class Imported:
    """An imported model: the text of its specification, the specification, and sentences on what has changed."""

    text: str
    spec: Spec
    notes: tuple[str, ...]


def import_file(path: str | Path) -> Imported:
    """Read a model from the file of another program. Nothing in it is executed.

    Raises
    ------
    SpecError
        If a part of it cannot be carried over; the message lists all such parts, with line and reason.
    """
    path = Path(path)
    read = _reader(path)
    source = read(path)
    source.first_parameter = next(iter(source.parameters), "")
    model = assembled(source)
    tables = {"kind": "sweep", "title": model.model.get("title", model.model["name"]), **first_tables(model)}
    spec = _checked(path, {**tables, "model": model.model}, source.notes)
    return Imported(_text(model, tables), spec, tuple(source.notes))


def _checked(path: Path, tables: dict[str, Any], notes: list[str]) -> Spec:
    """Return the specification, whose equations can be integrated; note starts at which they have no value."""
    try:
        spec = Spec.parse(tables)
        model = load_model(spec.reference)
        assert isinstance(model, TextModel)
        _ = model.derived
    except (SpecError, ModelError) as error:
        raise SpecError([f"{path.name}: {problem}" for problem in error.problems]) from None
    try:
        check_starts(spec)
    except SpecError as error:
        notes += error.problems
    return spec


def _reader(path: Path) -> Callable[[Path], Source]:
    if path.suffix not in READERS:
        raise SpecError(f"{path}: files that end in {', '.join(READERS)} are read.")
    module, _, name = READERS[path.suffix].partition(":")
    found: Callable[[Path], Source] = getattr(import_module(module), name)
    return found


def import_model(path: str | Path) -> Spec:
    """Return a first specification with the model in the file of another program. Nothing in the file is executed.

    Parameters
    ----------
    path
        A file of XPPAUT (``.ode``), MatCont (``.m``) or AUTO (``.f90``, ``.f``, ``.c``); or in SBML (``.xml``,
        ``.sbml``), with the extra ``sbml``.

    Returns
    -------
    Spec
        With the model (``spec.model``), a section or drive, the file's initial values, and a range of a parameter.
        ``spec.save("NAME.toml")`` writes it; ``magpend model import`` also writes the comments of the file.

    Warns
    -----
    UserWarning
        Of each name that was changed and each part that was left out.

    Raises
    ------
    SpecError
        If the file cannot be read, or a part of the model cannot be carried over; the message lists all such parts,
        with line and reason.

    Examples
    --------
    >>> spec = import_model("lorenz.ode")  # doctest: +SKIP
    >>> run = magpend.run(spec, "runs/lorenz")  # doctest: +SKIP
    """
    found = import_file(path)
    for note in found.notes:
        warnings.warn(note, stacklevel=2)
    return found.spec


def write_import(path: Path, out: Path | None) -> tuple[Path, tuple[str, ...]]:
    """Write the specification of an imported model; return its file and the notes.

    Raises
    ------
    SpecError
        As `import_file`; or if the file to write exists or its folder does not.
    """
    target = check_new_file(out or Path(f"{path.stem}.toml"), [".toml"])
    refuse_place(target)
    found = import_file(path)
    write_new(target, found.text, "--out")
    return target, found.notes


def _text(model: Assembled, tables: dict[str, Any]) -> str:
    """Return the file: comments, the model with the comments of its parts, and the specification beneath it."""
    source, table = model.source, model.model
    lines = [f"# {plain(source.path.name)} of {source.program}, imported by magpend model import"]
    lines += [f"# {plain(comment)}".rstrip() for comment in source.head]
    lines += [f"{key} = {toml_value(value)}" for key, value in tables.items() if not isinstance(value, dict)]
    of = {new: old for old, new in model.names.items()}
    told: set[str] = set()

    def comments(name: str) -> list[str]:
        old = of.get(name, "")
        if old in told:
            return []
        told.add(old)
        return [f"# {plain(comment)}".rstrip() for comment in source.comments.get(old, [])]

    lines += ["", "[model]"]
    lines += [f"{k} = {toml_value(v)}" for k, v in table.items() if isinstance(v, str)]
    for key in ("states", "parameters", "define", "equations", "quantities"):
        if key in table:
            lines += ["", f"[model.{key}]"]
            for name, value in table[key].items():
                lines += [] if key == "states" else comments(name)
                lines.append(f"{toml_key(name)} = {'{}' if value == {} else toml_value(value)}")
    for impact in table.get("impacts", ()):
        lines += ["", "[[model.impacts]]", *(f"{k} = {toml_value(v)}" for k, v in impact.items())]
    for name, values in table.get("presets", {}).items():
        lines += ["", f"[model.presets.{name}]", *(f"{toml_key(k)} = {toml_value(v)}" for k, v in values.items())]
    rest = [c for name in source.comments if name not in told for c in source.comments[name]]
    lines += ["", *(f"# {plain(comment)}".rstrip() for comment in rest)] if rest else []
    lines += ["", "# A first specification: change it as you like."]
    for key, entries in tables.items():
        if isinstance(entries, dict):
            lines += ["", f"[{key}]", *(f"{toml_key(k)} = {toml_value(v)}" for k, v in entries.items())]
    return "\n".join(lines) + "\n"
