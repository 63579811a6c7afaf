"""Define what commands share: arguments, the output of tables."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.cli import console
from pipeline.cli.outputs import check_file, check_table

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
Json = Annotated[bool, typer.Option("--json", help="Write the table as JSON to the standard output.")]


def read_pairs(option: str, texts: list[str], example: str) -> dict[str, float]:
    """Parse texts of the form ``NAME=VALUE`` into numbers by name; raise a `SpecError` that lists all invalid texts."""
    from pipeline.specification.problems import SpecError

    found, problems = {}, []
    for text in texts:
        name, _, value = text.partition("=")
        try:
            found[name.strip()] = float(value)
        except ValueError:
            problems.append(f"{option} {text}: must be NAME=VALUE with a number, such as {example}.")
    if problems:
        raise SpecError(problems)
    return found


def check_csv(path: str | None) -> None:
    """Raise an error if a CSV file cannot be written, before anything is computed."""
    from pipeline.specification.problems import SpecError

    if path not in (None, "-") and (Path(str(path)).is_dir() or not Path(str(path)).parent.is_dir()):
        raise SpecError(f"--csv {path}: must be a file in a folder that exists.")
    if path not in (None, "-"):
        check_file(Path(str(path)), "--csv")


def tell(table: Table, csv: str | None, as_json: bool) -> None:
    """Print a table: its text lines, its rows as JSON with `as_json`, or its rows as CSV if `csv` is ``-``."""
    if csv == "-" and not as_json:
        console.result(table.csv().rstrip("\n"))
    else:
        tell_data(json_rows(table), table.lines, as_json)
    if csv not in (None, "-"):
        from pipeline.layout.writing import write_atomically

        text = table.csv()
        check_table(Path(str(csv)), text.partition("\n")[0])
        write_atomically(Path(str(csv)), text)
        console.note(f"table: {csv}")


def tell_data(data: Any, lines: Iterable[str], as_json: bool) -> None:
    """Print a result: as lines, or as JSON with `as_json`."""
    if as_json:
        console.result(json.dumps(data, indent=1))
    else:
        console.result(*lines)


def json_rows(table: Table) -> list[dict[str, Any]]:
    """Convert the rows of a table to types that JSON can hold."""
    from pipeline.layout.writing import json_value

    return [json_value(row) for row in table.rows]
