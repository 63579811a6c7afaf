"""The command line: parses, calls, prints. Everything heavy is imported by the command that needs it."""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.exits import Exit

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

_EXIT_HELP = "Exit codes: " + "; ".join(f"{int(code)} {code.sentence}" for code in Exit) + "."

app = typer.Typer(
    name="magpend",
    help="Sweeps, continuations and bifurcation diagrams of a forced double pendulum with magnets.",
    epilog=_EXIT_HELP,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
plot_app = typer.Typer(
    help="Draw figures from a stored cube; nothing is computed again.", no_args_is_help=True
)
app.add_typer(plot_app, name="plot")


class State(StrEnum):
    """States that can be drawn."""

    PSI1 = "psi1"
    PSI2 = "psi2"
    PSI1_DOT = "psi1_dot"
    PSI2_DOT = "psi2_dot"


class Layout(StrEnum):
    """How directions share a figure."""

    OVERLAY = "overlay"
    SIDE = "side"


class Format(StrEnum):
    """File formats of figures."""

    PNG = "png"
    PDF = "pdf"
    SVG = "svg"


Directory = Annotated[Path, typer.Argument(metavar="DIR", help="Run directory.")]


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


@app.command(epilog=_EXIT_HELP)
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
    plot: Annotated[bool, typer.Option("--plot", help="Draw the bifurcation diagram at the end.")] = False,
) -> None:
    """Compute what a specification asks for, or what is missing of it.

    Stop it whenever you like: the same command goes on where it was, and the finished files are the same.
    """
    from pipeline import run as runs

    if dry_run:
        for line in runs.describe_plan(spec, out, workers=workers, smoke=smoke):
            typer.echo(line)
        return
    state = runs.run(spec, out, workers=workers, scheduler=scheduler, smoke=smoke, echo=typer.echo)
    typer.echo(f"cube: {state.directory / 'cube.zarr'}")
    if plot:
        typer.echo(f"figure: {_bifurcation(state.directory)}")
    else:
        typer.echo(f"plot it with: magpend plot bifurcation {state.directory}")


@app.command(epilog=_EXIT_HELP)
def status(directory: Directory) -> None:
    """Say how much of a run is committed and what became of its cells."""
    from pipeline import run as runs

    for line in runs.describe_state(runs.state(directory)):
        typer.echo(line)


@app.command(epilog=_EXIT_HELP)
def verify(
    directory: Directory,
    repair: Annotated[
        bool,
        typer.Option("--repair", help="Withdraw damaged tasks, so that the next run computes them again."),
    ] = False,
) -> None:
    """Check every committed byte against the commit records."""
    from pipeline import verification

    found = verification.verify_run(directory, repair=repair)
    for line in verification.describe(found, directory, repaired=repair):
        typer.echo(line)
    if not (found.sound or (repair and not found.skeleton)):
        raise typer.Exit(Exit.DAMAGED)


@app.command(epilog=_EXIT_HELP)
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
    from pipeline import simulate as simulation

    simulation.check_output(out)
    target = figure or out.with_suffix(".png")
    if not no_figure:
        _check_figure_path(target)
    state = (_angle("psi1", psi1, psi1_deg), _angle("psi2", psi2, psi2_deg), psi1_dot, psi2_dot)
    ds = simulation.simulate(
        frequency_hz, state, preset=preset, overrides=_overrides(settings or []), n_transient=transient,
        n_periods=periods, samples_per_period=samples, rtol=rtol, atol=atol,
    )  # fmt: skip
    typer.echo(f"series: {simulation.write_series(ds, out)}")
    if not no_figure:
        from pipeline.plots import plot_trajectory

        typer.echo(f"figure: {_save(plot_trajectory(ds), target)}")


@app.command(epilog=_EXIT_HELP)
def presets(
    name: Annotated[str | None, typer.Argument(help="Show this preset alone.")] = None,
) -> None:
    """List the parameters: values, units, and where each comes from."""
    from rich.console import Console
    from rich.table import Table

    from magpend_core import load_preset, preset_names, preset_provenance
    from magpend_core.parameters import describe

    # Without a terminal rich would cut the table at 80 columns.
    console = Console(width=None if sys.stdout.isatty() else 160)
    for preset in [name] if name else preset_names():
        parameters = load_preset(preset)
        origin, about = preset_provenance(preset), describe(parameters)
        table = Table("name", "value", "unit", "meaning", "source", title=preset)
        for key, value in parameters.as_dict().items():
            table.add_row(key, f"{value:g}", about[key]["unit"], about[key]["meaning"], origin.get(key, ""))
        console.print(table)


@plot_app.command(epilog=_EXIT_HELP)
def bifurcation(
    directory: Directory,
    state: Annotated[State, typer.Option(help="What is drawn over the parameter.")] = State.PSI1,
    out: Annotated[Path | None, typer.Option(help="Figure file; by default in DIR/figures.")] = None,
    degrees: Annotated[bool, typer.Option("--degrees", help="Degrees instead of radians.")] = False,
    layout: Annotated[
        Layout, typer.Option(help="Both directions in one panel, or a panel each.")
    ] = Layout.OVERLAY,
    file_format: Annotated[
        Format | None, typer.Option("--format", help="File format; by default png, or that of --out.")
    ] = None,
) -> None:
    """Draw a bifurcation diagram: left, right and straddling motions over the swept parameter."""
    path = _bifurcation(directory, state.value, out, degrees, layout.value, file_format)
    typer.echo(f"figure: {path}")


def _bifurcation(
    directory: Path,
    state: str = "psi1",
    out: Path | None = None,
    degrees: bool = False,
    layout: str = "overlay",
    file_format: Format | None = None,
) -> Path:
    from pipeline import open_run
    from pipeline.plots import plot_bifurcation

    suffix = f".{(file_format or Format.PNG).value}"
    if out is None:
        target = directory / "figures" / f"bifurcation_{state}{suffix}"
    else:
        target = out.with_name(out.name + suffix) if file_format and out.suffix.lower() != suffix else out
        _check_figure_path(target)
    ds: xr.Dataset = open_run(directory)
    with _refusals(directory):
        figure = plot_bifurcation(ds, state=state, degrees=degrees, layout=layout)
    if out is None:
        target.parent.mkdir(exist_ok=True)
    return _save(figure, target)


@contextlib.contextmanager
def _refusals(directory: Path) -> Iterator[None]:
    """Say what is wrong with a cube or an option instead of failing with a trace."""
    from pipeline.problems import SpecError
    from pipeline.store import DamagedError

    try:
        yield
    except ValueError as error:
        if "checksum" in str(error).lower():
            raise DamagedError(
                f"{directory}: a chunk is damaged; look with: magpend verify {directory}"
            ) from None
        raise SpecError([f"{directory}: {error}"]) from None


def _save(figure: Figure, target: Path) -> Path:
    from pipeline.plots import save_figure

    return save_figure(figure, target)


def _check_figure_path(path: Path) -> None:
    """Refuse a path that cannot be written to, before anything is computed."""
    from pipeline.problems import SpecError

    suffixes = [f".{f.value}" for f in Format]
    if path.suffix.lower() not in suffixes:
        raise SpecError([f"{path}: the suffix must be one of {', '.join(suffixes)}."])
    if not path.parent.is_dir():
        raise SpecError([f"{path.parent}: no such folder; make it first."])


def _angle(name: str, radians: float | None, degrees: float | None) -> float:
    import math

    from pipeline.problems import SpecError

    if radians is not None and degrees is not None:
        raise SpecError([f"--{name} and --{name}-deg are both given; keep one."])
    return math.radians(degrees) if degrees is not None else (radians or 0.0)


def _overrides(settings: list[str]) -> dict[str, float]:
    """Read ``NAME=VALUE`` pairs."""
    from pipeline.problems import SpecError

    found, problems = {}, []
    for text in settings:
        name, _, value = text.partition("=")
        try:
            found[name.strip()] = float(value)
        except ValueError:
            problems.append(f"--set {text}: must be NAME=VALUE with a number, such as q=1.5.")
    if problems:
        raise SpecError(problems)
    return found


def _codes() -> list[tuple[tuple[type[BaseException], ...], Exit]]:
    """Exceptions that people can act on, and their exit codes."""
    from magpend_core.parameters import ParameterError
    from pipeline.execute import TaskFailedError
    from pipeline.problems import SpecError
    from pipeline.store import DamagedError, LockedError, StoreError

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
    from pipeline.run import InterruptedRunError

    if isinstance(error, InterruptedRunError):
        return Exit.TERMINATED if error.signal_number == signal.SIGTERM else Exit.INTERRUPTED
    return next((code for kinds, code in _codes() if isinstance(error, kinds)), Exit.BUG)


if __name__ == "__main__":
    main()
