"""``magpend branches``: periodic orbits followed along a parameter, and the table of their bifurcations."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.cli_common import Directory

if TYPE_CHECKING:
    import xarray as xr


def branches(
    directory: Directory,
    parameter: Annotated[
        str, typer.Option(help="What is varied: frequency_hz, or a parameter's name.")
    ] = "frequency_hz",
    low: Annotated[
        float | None, typer.Option("--from", help="Least value \\[SI]; by default what the run spans.")
    ] = None,
    high: Annotated[float | None, typer.Option("--to", help="Largest value \\[SI].")] = None,
    period: Annotated[int, typer.Option(help="Longest period of a branch \\[drive periods].")] = 4,
    generations: Annotated[
        int, typer.Option(help="How often branches that spring from branches are followed.")
    ] = 3,
    recurrences: Annotated[
        int,
        typer.Option(
            help="Start also from orbits, up to this period, near close recurrences of bounded cells."
        ),
    ] = 0,
    csv: Annotated[Path | None, typer.Option(help="Write the table of bifurcations to this file.")] = None,
) -> None:
    """Follow periodic orbits along a parameter, stable or not; locate and name their bifurcations.

    Starts from the closed orbits that attract cells of the run. The result is kept in DIR/derived.
    """
    from pipeline import derived_branches

    ds = derived_branches.branches(
        directory, parameter=parameter, low=low, high=high, max_period=period, generations=generations,
        recurrences=recurrences, echo=typer.echo,
    )  # fmt: skip
    for line in (*_table(ds), "", *_windows(ds)):
        typer.echo(line)
    if csv is not None:
        csv.write_text("\n".join(_csv(ds)) + "\n", "utf-8")
        typer.echo(f"table: {csv}")


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
                f"{row['branch']}{to}",
            )
        )  # fmt: skip
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)) for row in rows]
    return [f"{ds.sizes['bifurcation']} bifurcations on {ds.sizes['branch']} branches", "", *lines]


def _number(z: complex) -> str:
    return f"{z.real:.5f}" if abs(z.imag) < 1e-9 else f"{z.real:.5f}{z.imag:+.5f}i"


def _windows(ds: xr.Dataset) -> list[str]:
    from pipeline.analysis.branches import windows_of

    lines = ["stable segments"]
    for w in windows_of(ds):
        ends = f"{w['from']:.7f} ({w['begins']}) to {w['to']:.7f} ({w['ends']})"
        lines.append(f"  period {w['period']}, {w['side']}, branch {w['branch']}: {ends}")
    return lines


def _csv(ds: xr.Dataset) -> list[str]:
    from pipeline.analysis.branches import table_of

    names = (
        "value", "bracket", "type", "criticality", "period", "side", "multiplier_real", "multiplier_imag",
        "unstable_below", "unstable_above", "branch", "to_branch",
    )  # fmt: skip
    rows: list[dict[str, Any]] = [
        {**row, "multiplier_real": row["multiplier"].real, "multiplier_imag": row["multiplier"].imag}
        for row in table_of(ds)
    ]
    parameter = str(ds.attrs["parameter"])
    head = ",".join(parameter if n == "value" else n for n in names)
    return [head, *(",".join(str(row[n]) for n in names) for row in rows)]
