"""Define ``magpend zoom``, which writes a specification with narrower ranges."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from pipeline.cli import console
from pipeline.cli.common import read_pairs
from pipeline.cli.simulate import read_named

_NUM = "num_"


def zoom(
    context: typer.Context,
    source: Annotated[
        str, typer.Argument(metavar="DIR|SPEC", help="A run directory, a TOML file, or a shipped workflow.")
    ],
    out: Annotated[Path, typer.Option(help="TOML file to write; an existing one is not overwritten.")],
    axis: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=LOW:HIGH[:NUM]", help="New range of a parameter or state, by name."),
    ] = None,
    at: Annotated[
        list[str] | None, typer.Option(metavar="NAME=VALUE", help="One value of a parameter, the frequency or a state.")
    ] = None,
    num: Annotated[
        int | None, typer.Option(min=2, help="Number of points of every new range; by default as before.")
    ] = None,
    samples: Annotated[int | None, typer.Option(min=1, help="Number of random initial states.")] = None,
) -> None:
    """Write a new specification with narrower ranges; everything else stays unchanged.

    Give new ranges by name with two numbers: --frequency 2.1 2.3 [Hz], --NAME LOW HIGH for a state or a
    parameter, --NAME-deg LOW HIGH for an angle. --num-NAME N gives a range its own number of points. The new
    specification is validated before it is written. Run it with: magpend run OUT
    """
    from pipeline.layout.vocabulary import parameter_name
    from pipeline.runs.zoom import Changes, read_source, write_zoom

    ranges, nums = _named(context.args)
    more, more_nums = _axes(axis or [])
    pins = read_pairs("--at", at or [], "frequency=2.2")
    changes = Changes(
        {parameter_name(name): pair for name, pair in {**ranges, **more}.items()},
        {parameter_name(name): value for name, value in pins.items()},
        num,
        {parameter_name(name): n for name, n in {**nums, **more_nums}.items()},
        samples,
    )
    for line in write_zoom(read_source(source), changes, out):
        console.note(f"note: {line}")
    console.result(f"specification: {out}")


def _named(words: list[str]) -> tuple[dict[str, Any], dict[str, int]]:
    """Parse ``--NAME LOW HIGH`` and ``--num-NAME N`` into ranges and numbers of points, by name."""
    from pipeline.specification.problems import SpecError

    numbered: list[str] = []
    ranged: list[str] = []
    into = ranged
    for word in words:
        if word.startswith("--"):
            into = numbered if word.startswith("--num-") else ranged
        into.append(word)
    problems, nums = [], {}
    for name, (n,) in read_named(numbered, 1).items():
        if n != int(n) or n < 2:
            problems.append(f"--{name.replace('_', '-')} {n:g}: must be a whole number, 2 or more.")
        nums[name.removeprefix(_NUM)] = int(n)
    if problems:
        raise SpecError(problems)
    return read_named(ranged, 2), nums


def _axes(texts: list[str]) -> tuple[dict[str, tuple[float, float]], dict[str, int]]:
    """Parse ``--axis`` texts, ``NAME=LOW:HIGH`` or ``NAME=LOW:HIGH:NUM``, into ranges and numbers of points."""
    from pipeline.specification.problems import SpecError

    ranges, points, problems = {}, {}, []
    for text in texts:
        name, _, values = text.partition("=")
        low, high, *rest = (*values.split(":"), "")
        try:
            ranges[name.strip()] = float(low), float(high)
            if len(rest) == 2:
                points[name.strip()] = int(rest[0])
            elif len(rest) > 2:
                raise ValueError
        except ValueError:
            problems.append(f"--axis {text}: must be NAME=LOW:HIGH or NAME=LOW:HIGH:NUM, as in q=1.5:1.6:11.")
    if problems:
        raise SpecError(problems)
    return ranges, points
