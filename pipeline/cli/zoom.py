"""``magpend zoom``: a narrower specification from an old one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from pipeline.cli.common import read_pairs


def _range(what: str) -> Any:
    return typer.Option(metavar="LOW HIGH", help=f"New range: {what}.")


def _number(what: str) -> Any:
    return typer.Option(min=2, help=f"Points of {what} alone.")


Pair = tuple[float, float] | None


def zoom(
    source: Annotated[
        str,
        typer.Argument(metavar="DIR|SPEC", help="A run directory, a TOML file, or a shipped workflow."),
    ],
    out: Annotated[Path, typer.Option(help="TOML file to write; an existing one is not overwritten.")],
    psi1: Annotated[Pair, _range("initial angle of link 1 \\[rad]")] = None,
    psi1_deg: Annotated[Pair, _range("the same in degrees")] = None,
    psi2: Annotated[Pair, _range("initial angle of link 2 \\[rad]")] = None,
    psi2_deg: Annotated[Pair, _range("the same in degrees")] = None,
    psi1_dot: Annotated[Pair, _range("initial rate of link 1 \\[rad/s]")] = None,
    psi1_dot_deg: Annotated[Pair, _range("the same in degrees/s")] = None,
    psi2_dot: Annotated[Pair, _range("initial rate of link 2 \\[rad/s]")] = None,
    psi2_dot_deg: Annotated[Pair, _range("the same in degrees/s")] = None,
    frequency_hz: Annotated[Pair, _range("drive frequency \\[Hz]")] = None,
    axis: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=LOW:HIGH[:NUM]", help="New range of a parameter, by name, SI units."),
    ] = None,
    at: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="One value of a parameter, frequency_hz or a state's key."),
    ] = None,
    num: Annotated[
        int | None,
        typer.Option(min=2, help="Points of every new range; by default as many as before."),
    ] = None,
    num_psi1: Annotated[int | None, _number("psi1")] = None,
    num_psi2: Annotated[int | None, _number("psi2")] = None,
    num_psi1_dot: Annotated[int | None, _number("psi1_dot")] = None,
    num_psi2_dot: Annotated[int | None, _number("psi2_dot")] = None,
    num_frequency_hz: Annotated[int | None, _number("frequency_hz")] = None,
    samples: Annotated[int | None, typer.Option(min=1, help="Number of random initial states.")] = None,
) -> None:
    """Write a new specification with narrower ranges; everything else stays as it was.

    It is validated before it is written. Run it with: magpend run OUT
    """
    from pipeline.runs.zoom import Changes, read_source, write_zoom

    ranges = {
        "psi1": psi1, "psi1_deg": psi1_deg, "psi2": psi2, "psi2_deg": psi2_deg, "psi1_dot": psi1_dot,
        "psi1_dot_deg": psi1_dot_deg, "psi2_dot": psi2_dot, "psi2_dot_deg": psi2_dot_deg,
        "frequency_hz": frequency_hz,
    }  # fmt: skip
    nums = {
        "psi1": num_psi1, "psi2": num_psi2, "psi1_dot": num_psi1_dot, "psi2_dot": num_psi2_dot,
        "frequency_hz": num_frequency_hz,
    }  # fmt: skip
    given = {key: pair for key, pair in ranges.items() if pair is not None}
    points = {key: n for key, n in nums.items() if n is not None}
    more, more_points = _axes(axis or [])
    changes = Changes(
        {**given, **more},
        read_pairs("--at", at or [], "frequency_hz=2.2"),
        num,
        {**points, **more_points},
        samples,
    )
    for note in write_zoom(read_source(source), changes, out):
        typer.echo(f"note: {note}")
    typer.echo(f"specification: {out}")


def _axes(texts: list[str]) -> tuple[dict[str, tuple[float, float]], dict[str, int]]:
    """Read ``NAME=LOW:HIGH`` and ``NAME=LOW:HIGH:NUM``."""
    from pipeline.spec.problems import SpecError

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
