"""Define what commands share: arguments, the output of tables."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.cli import console
from pipeline.cli.outputs import check_document, check_file, check_place, check_table

if TYPE_CHECKING:
    from pipeline.products.product import Table

UsageError: Any = typer.BadParameter.__base__
"""The error class of the command line for unknown words, from typer's own copy of click."""

CommandError: Any = UsageError.__base__

# str, since Path would turn the two slashes of s3://BUCKET into one
Directory = Annotated[str, typer.Argument(metavar="DIR", help="Run directory, or s3://BUCKET/PREFIX.")]
Csv = Annotated[
    str | None,
    typer.Option("--csv", metavar="FILE", help="Write the table as CSV; - writes it to the standard output."),
]
Saved = Annotated[
    Path | None,
    typer.Option(
        "--out",
        metavar="FILE",
        help="Write the whole result: .nc (NetCDF), .mat (MATLAB); branches also as b.NAME (AUTO).",
    ),
]
MAPPING = "Mapping file (TOML) from channels to states."
PresetName = Annotated[
    str | None, typer.Option(help="Parameter preset, or a preset's file, FILE.toml; by default the model's first.")
]
Set = Annotated[list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="Change a parameter.")]
PRINTED = "-"
"""Value of ``--csv`` and ``--json`` that stands for the standard output."""


def _json_target(path: str | None) -> str | None:
    check_target(path, "--json")
    return path


Json = Annotated[
    str | None,
    typer.Option(
        "--json",
        metavar="[FILE.json]",
        callback=_json_target,
        help="Write the result as JSON to a file, or without one to the standard output and nothing else.",
    ),
]
"""`pipeline.cli.groups.FileCommand` gives it the value `PRINTED` if no file follows."""


def read_pairs(option: str, texts: list[str], example: str) -> dict[str, float]:
    """Parse texts of the form ``NAME=VALUE`` into numbers by name; raise a `SpecError` that lists all invalid texts."""
    from pipeline.specification.problems import SpecError

    found, problems = {}, []
    for text in [part for given in texts for part in given.split(",")]:
        name, _, value = text.partition("=")
        try:
            found[name.strip()] = float(value)
        except ValueError:
            problems.append(f"{option} {text}: must be NAME=VALUE with a number, such as {example}.")
    if problems:
        raise SpecError(problems)
    return found


def read_ranges(option: str, texts: list[str]) -> dict[str, tuple[float, float]]:
    """Parse texts of the form ``NAME=LOW:HIGH`` into pairs by name; raise a `SpecError` that lists invalid texts."""
    from pipeline.specification.problems import SpecError

    found, problems = {}, []
    for text in [part for given in texts for part in given.split(",")]:
        name, _, ends = text.partition("=")
        try:
            low, high = map(float, ends.split(":"))
            found[name.strip()] = low, high
        except ValueError:
            problems.append(f"{option} {text}: must be NAME=LOW:HIGH with two numbers, such as x=-2:2.")
    if problems:
        raise SpecError(problems)
    return found


def check_csv(path: str | None) -> None:
    """Raise an error if a CSV file cannot be written, before anything is computed."""
    check_target(path, "--csv")
    if path not in (None, PRINTED):
        check_file(Path(str(path)), "--csv")


def check_saved(path: Path | None) -> None:
    """Raise an error if the file of a result cannot be written, before anything is computed."""
    if path is not None:
        from pipeline.runs.exporting import format_of

        format_of(path)
        check_file(path)


def check_target(path: str | None, option: str) -> None:
    """Raise an error if a file to write lies in no folder, or in a run directory."""
    from pipeline.specification.problems import SpecError

    if path is None or path == PRINTED:
        return
    if Path(path).is_dir() or not Path(path).parent.is_dir():
        raise SpecError(f"{option} {path}: must be a file in a folder that exists.")
    check_place(Path(path), option)


def tell(table: Table, csv: str | None, as_json: str | None) -> None:
    """Print a table as text, CSV or JSON, and write it to the files that `csv` and `as_json` name."""
    from pipeline.layout.writing import json_value

    data = json_rows(table) if table.graph is None else json_value(table.graph)
    tell_data(data, [table.csv().rstrip("\n")] if csv == PRINTED else table.lines, as_json)
    if csv not in (None, "-"):
        from pipeline.layout.writing import write_atomically

        text = table.csv()
        check_table(Path(str(csv)), text.partition("\n")[0])
        write_atomically(Path(str(csv)), text)
        console.note(f"table: {csv}")


def tell_data(data: Any, lines: Iterable[str], as_json: str | None) -> None:
    """Print a result as lines or as JSON, and write it to the file that `as_json` names."""
    if as_json == PRINTED:
        console.result(json.dumps(data, indent=1))
        return
    console.result(*lines)
    if as_json is not None:
        from pipeline.layout.writing import write_atomically

        check_document(Path(as_json), data)
        write_atomically(Path(as_json), json.dumps(data, indent=1) + "\n")
        console.note(f"JSON: {as_json}")


def json_rows(table: Table) -> list[dict[str, Any]]:
    """Convert the rows of a table to types that JSON can hold."""
    from pipeline.layout.writing import json_value

    return [json_value(row) for row in table.rows]
