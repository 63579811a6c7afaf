"""Define ``magpend model``, which shows a model's equations or writes a template for a new model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.cli import console
from pipeline.cli.common import Json, tell_data
from pipeline.cli.console import Exit
from pipeline.cli.groups import add_command, command_group
from pipeline.cli.models import all_of, described
from pipeline.cli.options import completing

if TYPE_CHECKING:
    from magpend_core.models.model import Model
    from magpend_core.models.summary import Description

model_app = command_group("Your own system as text: begin one, and check how magpend reads it.")


def _names() -> list[str]:
    from magpend_core.models import model_names

    return list(model_names())


def show(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME|FILE",
            help="Model's name, its file, a specification, or package.module:NAME.",
            autocompletion=completing(_names),
        ),
    ],
    latex: Annotated[bool, typer.Option("--latex", help="Print only the equations, in LaTeX.")] = False,
    json: Json = None,
) -> None:
    """Show a model's equations as magpend reads them, the detected discontinuities, and checks.

    Integration steps are adapted to the detected edges of the drive, steep layers, switches and impacts. The
    checks evaluate the equations at the starts of a specification, or near 0, and compile nothing.
    """
    from pipeline.runs.modelling import examine

    model, found = examine(name)
    if json:
        tell_data(_as_dict(model, found), _lines(model, found), json)
    elif latex:
        _latex(model, found)
    else:
        console.result(*_lines(model, found))
    if found.problems:
        raise typer.Exit(Exit.REFUSED)


def new(
    file: Annotated[
        Path | None, typer.Argument(metavar="[FILE]", help="TOML file to write; by default the standard output.")
    ] = None,
) -> None:
    """Write a commented specification with a model of your own as a template; it runs unchanged."""
    from pipeline.runs.modelling import write_template

    if file is None:
        console.result(write_template(None).rstrip("\n"))
        return
    write_template(file)
    console.result(f"specification: {file}")
    console.note(f"look at it with: magpend model show {file}; run it with: magpend run {file} --smoke")


def import_(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="File of XPPAUT (.ode), MatCont (.m), AUTO (.f90, .c) or SBML (.xml)."),
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="NAME.toml", help="File to write; by default named after FILE.")
    ] = None,
) -> None:
    """Write the model of another program's file as a specification that runs. Nothing in the file is executed.

    The specification has the model as text, with the file's parameters, initial values and comments, and a first
    section, starts and range of a parameter. What was renamed or left out is printed. If a part of the model cannot be
    carried over, nothing is written, and each such part is told with its line and reason.
    """
    from pipeline.importing.importing import write_import

    target, notes = write_import(file, out)
    console.note(*notes)
    console.result(f"specification: {target}")
    console.note(f"look at it with: magpend model show {target}; run it with: magpend run {target} --plot")


import_.__name__ = "import"
for _command in (show, new, import_):
    add_command(model_app, _command, _command.__name__)


def _lines(model: Model, found: Description) -> list[str]:
    from magpend_core.models.summary import checks_of

    lines, is_flow = all_of(model), model.clock.is_continuous
    if found.equations:
        lines += ["", "equations"]
        lines += [f"  {name} = {text}" for name, text in found.definitions.items()]
        lines += [f"  d{name}/dt = {t}" if is_flow else f"  {name}' = {t}" for name, t in found.equations.items()]
    if is_flow:  # no step of a map goes across anything
        lines += ["", "found", *(f"  {line}" for line in found.found or ["no edges, layers, switches or impacts"])]
    if model.remarks:
        lines += ["", "warnings", *(f"  {line}" for line in model.remarks)]
    if found.problems:
        lines += ["", "checks: failed", *(f"  {line}" for line in found.problems)]
    else:
        lines += ["", f"checks: passed ({'; '.join(checks_of(model))})"]
    return lines


def _latex(model: Model, found: Description) -> None:
    from pipeline.specification.problems import SpecError

    if not found.latex:
        raise SpecError(
            f"--latex: {model.name} is not a text model, so its equations cannot be written; drop the option."
        )
    console.result("\\begin{align}")
    console.result(" \\\\\n".join(f"  {line}" for line in found.latex))
    console.result("\\end{align}")


def _as_dict(model: Model, found: Description) -> dict[str, Any]:
    return {
        **described(model),
        "kind": model.clock.kind,
        "has_drive": model.clock.has_drive,
        "section": model.section,
        "digest": model.digest,
        "definitions": found.definitions,
        "equations": found.equations,
        "latex": found.latex,
        "found": found.found,
        "warnings": list(model.remarks),
        "problems": found.problems,
    }
