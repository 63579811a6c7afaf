"""``magpend branches``: periodic orbits followed along a parameter, and the table of their bifurcations."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.cli.common import Directory, refusals
from pipeline.cli.plot import Degrees, FileFormat, Out, State, figure_target

if TYPE_CHECKING:
    import xarray as xr

Parameter = Annotated[str, typer.Option(help="What is varied: frequency_hz, or a parameter's name.")]
Low = Annotated[
    float | None, typer.Option("--from", help="Least value \\[SI]; by default what the run spans.")
]
High = Annotated[float | None, typer.Option("--to", help="Largest value \\[SI].")]
Period = Annotated[int, typer.Option(help="Longest period of a branch \\[drive periods].")]
Generations = Annotated[int, typer.Option(help="How often branches that spring from branches are followed.")]
Recurrences = Annotated[
    int,
    typer.Option(help="Start also from orbits, up to this period, near close recurrences of bounded cells."),
]


def _options(
    parameter: str, low: float | None, high: float | None, period: int, generations: int, recurrences: int
) -> dict[str, Any]:
    return {
        "parameter": parameter, "low": low, "high": high, "max_period": period, "generations": generations,
        "recurrences": recurrences, "echo": typer.echo,
    }  # fmt: skip


def branches(
    directory: Directory,
    parameter: Parameter = "frequency_hz",
    low: Low = None,
    high: High = None,
    period: Period = 4,
    generations: Generations = 3,
    recurrences: Recurrences = 0,
    csv: Annotated[Path | None, typer.Option(help="Write the table of bifurcations to this file.")] = None,
) -> None:
    """Follow periodic orbits along a parameter, stable or not; locate and name their bifurcations.

    Starts from the closed orbits that attract cells of the run. The result is kept in DIR/derived.
    """
    from pipeline.analysis.branches import product as derived_branches
    from pipeline.spec.problems import SpecError

    if csv is not None and not csv.parent.is_dir():
        raise SpecError([f"{csv.parent}: no such folder; make it first."])
    ds = derived_branches.branches(
        directory, **_options(parameter, low, high, period, generations, recurrences)
    )
    for line in (*_table(ds), "", *_windows(ds)):
        typer.echo(line)
    if csv is not None:
        csv.write_text("\n".join(_csv(ds)) + "\n", "utf-8")
        typer.echo(f"table: {csv}")


def draw_branches(
    directory: Directory,
    parameter: Parameter = "frequency_hz",
    low: Low = None,
    high: High = None,
    period: Period = 4,
    generations: Generations = 3,
    recurrences: Recurrences = 0,
    over: Annotated[
        Path | None, typer.Option(help="Run over the same parameter that is drawn below; by default DIR.")
    ] = None,
    shown: Annotated[int | None, typer.Option(help="Longest period drawn \\[drive periods].")] = None,
    state: Annotated[State, typer.Option(help="What is drawn over the parameter.")] = State.PSI1,
    out: Out = None,
    degrees: Degrees = False,
    file_format: FileFormat = None,
) -> None:
    """Draw branches of periodic orbits over the bifurcation diagram: solid stable, dashed unstable."""
    target = figure_target(directory, f"branches_{state.value}", out, file_format)
    from pipeline import open_run
    from pipeline.analysis.branches import product as derived_branches
    from pipeline.plots import plot_branches, save_figure

    ds = derived_branches.branches(
        directory, **_options(parameter, low, high, period, generations, recurrences)
    )
    cube = open_run(over or directory)
    axis = "frequency" if parameter == "frequency_hz" else parameter
    with refusals(directory):
        below = cube if axis in cube.dims else None
        figure = plot_branches(ds, below, state=state.value, max_period=shown, degrees=degrees)
    target.parent.mkdir(exist_ok=True)
    typer.echo(f"figure: {save_figure(figure, target)}")


def draw_multipliers(
    directory: Directory,
    branch: Annotated[int, typer.Option(help="Number of the branch, as in the table.")] = 0,
    parameter: Parameter = "frequency_hz",
    low: Low = None,
    high: High = None,
    period: Period = 4,
    generations: Generations = 3,
    recurrences: Recurrences = 0,
    out: Out = None,
    file_format: FileFormat = None,
) -> None:
    """Draw the Floquet multipliers along a branch in the complex plane, with the unit circle."""
    target = figure_target(directory, f"multipliers_{branch}", out, file_format)
    from pipeline.analysis.branches import product as derived_branches
    from pipeline.plots import plot_multipliers, save_figure

    ds = derived_branches.branches(
        directory, **_options(parameter, low, high, period, generations, recurrences)
    )
    with refusals(directory):
        figure = plot_multipliers(ds, branch)
    target.parent.mkdir(exist_ok=True)
    typer.echo(f"figure: {save_figure(figure, target)}")


def draw_curves(
    directory: Directory,
    second: Annotated[str, typer.Option(help="Second parameter's name, such as q.")],
    second_low: Annotated[float, typer.Option("--second-from", help="Its least value \\[SI].")],
    second_high: Annotated[float, typer.Option("--second-to", help="Its largest value \\[SI].")],
    curve_period: Annotated[int, typer.Option(help="Longest period of the orbits \\[drive periods].")] = 1,
    parameter: Parameter = "frequency_hz",
    low: Low = None,
    high: High = None,
    period: Period = 4,
    generations: Generations = 3,
    recurrences: Recurrences = 0,
    out: Out = None,
    file_format: FileFormat = None,
) -> None:
    """Draw curves of folds, period doublings and Neimark-Sacker points in the plane of two parameters.

    Continues the points that `magpend branches` locates; the curves are kept in DIR/derived.
    """
    target = figure_target(directory, f"curves_{second}", out, file_format)
    from pipeline.analysis.branches import product as derived_branches
    from pipeline.plots import plot_curves, save_figure

    options = _options(parameter, low, high, period, generations, recurrences)
    ds = derived_branches.curves(
        directory, second, second_low, second_high, curve_period=curve_period, **options
    )
    target.parent.mkdir(exist_ok=True)
    typer.echo(f"figure: {save_figure(plot_curves(ds), target)}")


def _table(ds: xr.Dataset) -> list[str]:
    from pipeline.analysis.branches import table_of

    names = ("type", "criticality", "period", "side", "multiplier", "unstable below, above", "branch")
    rows = [(str(ds.attrs["parameter"]), *names)]
    for row in table_of(ds):
        to = f" -> {row['to_branch']}" if row["to_branch"] >= 0 else ""
        rows.append(
            (
                f"{row['value']:.7f}", row["type"], row["criticality"], str(row["period"]), row["side"],
                _number(row["multiplier"]), f"{row['unstable_below']}, {row['unstable_above']}",
                f"{row['branch']}{to}{_at(row)}",
            )
        )  # fmt: skip
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)) for row in rows]
    return [f"{ds.sizes['bifurcation']} bifurcations on {ds.sizes['branch']} branches", "", *lines]


def _at(row: dict[str, Any]) -> str:
    """The drive's frequency, unless that is what is varied."""
    import math

    return "" if math.isnan(row["frequency_hz"]) else f" at {row['frequency_hz']:g} Hz"


def _number(z: complex) -> str:
    return f"{z.real:.5f}" if abs(z.imag) < 1e-9 else f"{z.real:.5f}{z.imag:+.5f}i"


def _windows(ds: xr.Dataset) -> list[str]:
    from pipeline.analysis.branches import windows_of

    lines = ["stable segments"]
    for w in windows_of(ds):
        ends = f"{w['from']:.7f} ({w['begins']}) to {w['to']:.7f} ({w['ends']})"
        lines.append(f"  period {w['period']}, {w['side']}, branch {w['branch']}{_at(w)}: {ends}")
    return lines


def _csv(ds: xr.Dataset) -> list[str]:
    from pipeline.analysis.branches import table_of

    names = (
        "value", "bracket", "type", "criticality", "period", "side", "multiplier_real", "multiplier_imag",
        "unstable_below", "unstable_above", "frequency_hz", "branch", "to_branch",
    )  # fmt: skip
    rows: list[dict[str, Any]] = [
        {**row, "multiplier_real": row["multiplier"].real, "multiplier_imag": row["multiplier"].imag}
        for row in table_of(ds)
    ]
    parameter = str(ds.attrs["parameter"])
    head = ",".join(parameter if n == "value" else n for n in names)
    return [head, *(",".join(str(row[n]) for n in names) for row in rows)]
