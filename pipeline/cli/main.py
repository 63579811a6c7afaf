"""The command line: parses, calls, prints. Everything heavy is imported by the command that needs it."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from pipeline.cli.analyse import analyse_app
from pipeline.cli.branches import branches, draw_branches, draw_curves, draw_multipliers
from pipeline.cli.common import EXIT_HELP, Directory, read_pairs
from pipeline.cli.exits import Exit
from pipeline.cli.plot import check_figure_path, draw_bifurcation, plot_app
from pipeline.cli.zoom import zoom

app = typer.Typer(
    name="magpend",
    help="Sweeps, continuations and bifurcation diagrams of a forced double pendulum with magnets.",
    epilog=EXIT_HELP,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.add_typer(analyse_app, name="analyse")
app.add_typer(plot_app, name="plot")
app.command(epilog=EXIT_HELP)(zoom)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib import metadata

        typer.echo(f"magpend {metadata.version('magpend')}")
        raise typer.Exit


@app.callback()
def _main(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and leave.")
    ] = False,
) -> None:
    pass


@app.command(epilog=EXIT_HELP)
def run(
    spec: Annotated[
        str, typer.Argument(metavar="SPEC", help="A TOML file, or the name of a shipped workflow.")
    ],
    out: Annotated[Path | None, typer.Option(help="Run directory; by default runs/NAME.")] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=0, help="Worker processes; 0 computes in this process. Default: all cores."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Address of a dask scheduler, or 'none'. Default: $DASK_SCHEDULER_ADDRESS, or own workers."
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be done; create nothing.")
    ] = False,
    smoke: Annotated[
        bool, typer.Option("--smoke", help="Run the specification's small size of seconds.")
    ] = False,
    plot: Annotated[
        bool,
        typer.Option("--plot", help="Draw the bifurcation diagram of one parameter at the end."),
    ] = False,
) -> None:
    """Compute what a specification asks for, or what is missing of it.

    Stop it whenever you like: the same command goes on where it was, and the finished files are the same.
    """
    from pipeline.runs import run as runs

    if dry_run:
        for line in runs.describe_plan(spec, out, workers=workers, smoke=smoke):
            typer.echo(line)
        return
    if plot:
        runs.check_diagram(spec, smoke=smoke)
    state = runs.run(spec, out, workers=workers, scheduler=scheduler, smoke=smoke, echo=typer.echo)
    typer.echo(f"cube: {state.directory / 'cube.zarr'}")
    if plot:
        typer.echo(f"figure: {draw_bifurcation(state.directory)}")
    else:
        typer.echo(f"plot it with: magpend plot {runs.first_figure(state.plan)} {state.directory}")


@app.command(epilog=EXIT_HELP)
def status(directory: Directory) -> None:
    """Say how much of a run is committed and what became of its cells."""
    from pipeline.runs import run as runs

    for line in runs.describe_state(runs.state(directory)):
        typer.echo(line)


@app.command(epilog=EXIT_HELP)
def verify(
    directory: Directory,
    repair: Annotated[
        bool,
        typer.Option("--repair", help="Withdraw damaged tasks, so that the next run computes them again."),
    ] = False,
) -> None:
    """Check every committed byte against the commit records."""
    from pipeline.runs import verify as verification

    found = verification.verify_run(directory, repair=repair)
    for line in verification.describe(found, directory, repaired=repair):
        typer.echo(line)
    if not (found.sound or (repair and not found.skeleton)):
        raise typer.Exit(Exit.DAMAGED)


@app.command(epilog=EXIT_HELP)
def simulate(
    frequency_hz: Annotated[float, typer.Option(help="Drive frequency \\[Hz].")] = 2.2,
    psi1: Annotated[float | None, typer.Option(help="Initial angle of link 1 \\[rad].")] = None,
    psi2: Annotated[float | None, typer.Option(help="Initial angle of link 2 \\[rad].")] = None,
    psi1_deg: Annotated[float | None, typer.Option(help="The same in degrees.")] = None,
    psi2_deg: Annotated[float | None, typer.Option(help="The same in degrees.")] = None,
    psi1_dot: Annotated[float, typer.Option(help="Initial rate of link 1 \\[rad/s].")] = 0.0,
    psi2_dot: Annotated[float, typer.Option(help="Initial rate of link 2 \\[rad/s].")] = 0.0,
    preset: Annotated[str, typer.Option(help="Parameter preset.")] = "wojna2018",
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="Change a parameter.")
    ] = None,
    transient: Annotated[int, typer.Option(help="Drive periods before the series begins.")] = 0,
    periods: Annotated[int, typer.Option(help="Drive periods of the series.")] = 10,
    samples: Annotated[int, typer.Option(help="Samples per period.")] = 200,
    rtol: Annotated[float, typer.Option(help="Relative tolerance.")] = 1e-8,
    atol: Annotated[float, typer.Option(help="Absolute tolerance.")] = 1e-8,
    out: Annotated[Path, typer.Option(help="Series, .csv or .nc.")] = Path("trajectory.csv"),
    figure: Annotated[
        Path | None, typer.Option(help="Figure, .png, .pdf or .svg; by default beside the series.")
    ] = None,
    no_figure: Annotated[bool, typer.Option("--no-figure", help="Write the series alone.")] = False,
) -> None:
    """Integrate one trajectory: a series as CSV or NetCDF, and a figure with phase portraits.

    Time 0 is a rising edge of the drive.
    """
    from pipeline.compute import simulate as simulation

    simulation.check_output(out)
    target = figure or out.with_suffix(".png")
    if not no_figure:
        check_figure_path(target)
    state = (_angle("psi1", psi1, psi1_deg), _angle("psi2", psi2, psi2_deg), psi1_dot, psi2_dot)
    ds = simulation.simulate(
        frequency_hz, state, preset=preset, overrides=read_pairs("--set", settings or [], "q=1.5"),
        n_transient=transient, n_periods=periods, samples_per_period=samples, rtol=rtol, atol=atol,
    )  # fmt: skip
    typer.echo(f"series: {simulation.write_series(ds, out)}")
    if not no_figure:
        from pipeline.plots import plot_trajectory, save_figure

        typer.echo(f"figure: {save_figure(plot_trajectory(ds), target)}")


app.command(epilog=EXIT_HELP)(branches)
plot_app.command("branches", epilog=EXIT_HELP)(draw_branches)
plot_app.command("multipliers", epilog=EXIT_HELP)(draw_multipliers)
plot_app.command("curves", epilog=EXIT_HELP)(draw_curves)


@app.command(epilog=EXIT_HELP)
def presets(
    name: Annotated[str | None, typer.Argument(help="Show this preset alone.")] = None,
) -> None:
    """List the parameters: values, units, and where each comes from."""
    from rich.console import Console
    from rich.table import Table

    from magpend_core import load_preset, preset_names, preset_provenance

    # Without a terminal rich would cut the table at 80 columns.
    console = Console(width=None if sys.stdout.isatty() else 160)
    for preset in [name] if name else preset_names():
        parameters = load_preset(preset)
        origin, about = preset_provenance(preset), {p.name: p for p in parameters.model.parameters}
        table = Table("name", "value", "unit", "meaning", "source", title=preset)
        for key, value in parameters.as_dict().items():
            table.add_row(key, f"{value:g}", about[key].unit, about[key].meaning, origin.get(key, ""))
        console.print(table)


def _angle(name: str, radians: float | None, degrees: float | None) -> float:
    import math

    from pipeline.spec.problems import SpecError

    if radians is not None and degrees is not None:
        raise SpecError([f"--{name} and --{name}-deg are both given; keep one."])
    return math.radians(degrees) if degrees is not None else (radians or 0.0)


def _codes() -> list[tuple[tuple[type[BaseException], ...], Exit]]:
    """Exceptions that people can act on, and their exit codes."""
    from magpend_core.models.parameters import ParameterError
    from pipeline.compute.execute import TaskFailedError
    from pipeline.spec.problems import SpecError
    from pipeline.store.directory import DamagedError, LockedError, StoreError

    return [
        ((LockedError,), Exit.LOCKED),
        ((DamagedError,), Exit.DAMAGED),
        ((SpecError, ParameterError, StoreError), Exit.REFUSED),
        ((TaskFailedError, ArithmeticError, OSError), Exit.FAILED),
    ]


def _complain(error: BaseException) -> None:
    """Print an error: one line per problem."""
    lines: list[Any] = getattr(error, "problems", None) or [str(error)]
    head = "magpend: " if len(lines) == 1 else f"magpend: {len(lines)} problems\n  "
    print(head + "\n  ".join(map(str, lines)), file=sys.stderr)


def main() -> None:
    """Entry point: run the command line and turn errors into messages and exit codes."""
    try:
        app()
    except Exception as error:
        code = _exit_code(error)
        if code is Exit.BUG:
            raise
        _complain(error)
        sys.exit(code)


def _exit_code(error: Exception) -> Exit:
    from pipeline.runs.run import InterruptedRunError

    if isinstance(error, InterruptedRunError):
        return Exit.TERMINATED if error.signal_number == signal.SIGTERM else Exit.INTERRUPTED
    return next((code for kinds, code in _codes() if isinstance(error, kinds)), Exit.BUG)


if __name__ == "__main__":
    main()
