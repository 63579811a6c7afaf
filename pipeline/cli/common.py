"""What the commands share: options, the list of exit codes, and how bad input is reported."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from pipeline.cli.exits import Exit

EXIT_HELP = "Exit codes: " + "; ".join(f"{int(code)} {code.sentence}" for code in Exit) + "."

Directory = Annotated[Path, typer.Argument(metavar="DIR", help="Run directory.")]


@contextlib.contextmanager
def refusals(directory: Path) -> Iterator[None]:
    """Say what is wrong with a cube or an option instead of failing with a trace."""
    from pipeline.spec.problems import SpecError
    from pipeline.store.errors import DamagedError

    try:
        yield
    except ValueError as error:
        if "checksum" in str(error).lower():
            raise DamagedError(
                f"{directory}: a chunk is damaged; look with: magpend verify {directory}"
            ) from None
        raise SpecError([f"{directory}: {error}"]) from None


def read_pairs(option: str, texts: list[str], example: str) -> dict[str, float]:
    """Read ``NAME=VALUE`` pairs with numbers; raises `SpecError` naming all that are none."""
    from pipeline.spec.problems import SpecError

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
