"""Define ``magpend simulate``, which integrates one trajectory of any model."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from magpend_core.defaults import ATOL, DRIVE_HZ, RTOL
from pipeline.cli import console
from pipeline.cli.common import PresetName, Set, read_pairs
from pipeline.cli.models import DEFAULT, names
from pipeline.cli.options import completing
from pipeline.cli.outputs import check_file
from pipeline.cli.plot import check_figure_path

if TYPE_CHECKING:
    import xarray as xr


ModelName = Annotated[
    str | None,
    typer.Option(
        help=f"Model: a name (see magpend models), a file with its text, or package.module:NAME; by default {DEFAULT}.",
        autocompletion=completing(names),
    ),
]
Frequency = Annotated[
    float | None,
    typer.Option(
        "--frequency-hz",
        "--frequency",
        help=f"Drive frequency [Hz]; by default {DRIVE_HZ:g}. Without a drive a period is 1 s.",
    ),
]

EXTRA = {"ignore_unknown_options": True, "allow_extra_args": True}
"""Settings for commands whose options include a model's states by name."""


def simulate(
    context: typer.Context,
    model: ModelName = None,
    frequency_hz: Frequency = None,
    drive: Annotated[
        Path | None, typer.Option(help="Drive file with a recorded drive (see magpend recordings drive).")
    ] = None,
    preset: PresetName = None,
    settings: Set = None,
    transient: Annotated[int, typer.Option(help="Drive periods before the series begins.")] = 0,
    periods: Annotated[
        int | None, typer.Option(help="Drive periods of the series; by default 10, or all that a drive file has.")
    ] = None,
    samples: Annotated[int, typer.Option(help="Samples per period.")] = 200,
    rtol: Annotated[float, typer.Option(help="Relative tolerance.")] = RTOL,
    atol: Annotated[float, typer.Option(help="Absolute tolerance.")] = ATOL,
    method: Annotated[str, typer.Option(help="dopri5, or rodas5p for stiff equations.")] = "dopri5",
    out: Annotated[
        Path, typer.Option(help="Series: .csv, .nc (NetCDF), .mat (MATLAB) or .dat (a start of AUTO).")
    ] = Path("trajectory.csv"),
    figure: Annotated[
        Path | None, typer.Option(help="Figure, .png, .pdf or .svg; by default beside the series.")
    ] = None,
    no_figure: Annotated[bool, typer.Option("--no-figure", help="Draw no figure.")] = False,
) -> None:
    """Integrate one trajectory: states and the model's quantities in a file, and a figure.

    Give the initial state by the model's names: --NAME VALUE, or --NAME-deg VALUE for an angle or its rate;
    other states are 0. Time 0 is the time of a section. The command prints whether the motion has closed on a
    periodic orbit, or how long a transient it would need. With --drive the initial state is that at the start
    of the recording, and time is the recording's.
    """
    from pipeline.compute import simulate as simulation
    from pipeline.runs.exporting import format_of, save
    from pipeline.specification.models import find_model
    from pipeline.store.provenance import provenance, versions

    chosen = find_model(model or DEFAULT, at="--model")
    format_of(out)
    check_file(out)
    target = figure or out.with_suffix(".png")
    if not no_figure:
        check_figure_path(target)
    overrides = read_pairs("--set", settings or [], "q=1.5")
    frequency, overrides = simulation.with_rate(overrides.pop("frequency", frequency_hz), overrides, chosen)
    if frequency is None and drive is None:
        frequency = chosen.clock.default_hz
    ds = simulation.simulate(
        frequency,
        simulation.start_of(chosen, read_states(context.args)),
        drive=drive,
        model=chosen,
        preset=preset,
        overrides=overrides,
        n_transient=transient,
        n_periods=periods,
        samples_per_period=samples,
        rtol=rtol,
        atol=atol,
        method=method,
    )
    ds = ds.assign_attrs(versions=json.dumps(versions()), **provenance())
    console.result(f"series: {save(ds, out)}")
    if "closing" in ds.attrs:
        console.note(ds.attrs["closing"])
    if not no_figure:
        _draw(ds, target, out)


def _draw(ds: xr.Dataset, target: Path, series: Path) -> None:
    from pipeline.plots import plot_trajectory, save_data, save_figure

    figure = plot_trajectory(ds)
    console.result(f"figure: {save_figure(figure, target)}")
    if target.with_suffix(".nc").resolve() != series.resolve():
        console.result(f"data: {save_data(figure, target)}")


def read_states(words: list[str]) -> dict[str, float]:
    """Parse ``--NAME VALUE`` pairs into the values of states by name."""
    return {name: values[0] for name, values in read_named(words, 1).items()}


def read_named(words: list[str], n: int) -> dict[str, Any]:
    """Parse options ``--NAME VALUE ...`` with `n` numbers each into a dict; raise a `SpecError` that lists all
    mistakes.
    """
    from pipeline.specification.problems import SpecError

    found: dict[str, Any] = {}
    problems, left = [], list(words)
    while left:
        word = left.pop(0)
        own: list[str] = []
        name, is_joined, value = word.partition("=")
        if is_joined:
            left.insert(0, value)
        while left and len(own) < n and not left[0].startswith("--"):
            own.append(left.pop(0))
        try:
            if not name.startswith("--") or len(own) != n:
                raise ValueError
            found[name[2:].replace("-", "_")] = tuple(map(float, own))
        except ValueError:
            numbers = "a number" if n == 1 else f"{n} numbers"
            problems.append(
                f"{' '.join([word, *own])}: is neither an option of this command nor a name with {numbers}."
            )
    if problems:
        raise SpecError(problems)
    return found
