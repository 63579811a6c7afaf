"""``magpend analyse``: attractors, basins, hysteresis and chaos of a stored cube."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from pipeline.cli.common import EXIT_HELP, Directory, read_pairs, refusals

if TYPE_CHECKING:
    import xarray as xr

analyse_app = typer.Typer(
    help="Find attractors, basins, hysteresis and chaos in a stored cube; results are kept in DIR/derived.",
    no_args_is_help=True,
)

F = TypeVar("F", bound=Callable[..., Any])


class Interval(StrEnum):
    """Confidence intervals of fractions."""

    WILSON = "wilson"
    CLOPPER_PEARSON = "clopper-pearson"


class Scaling(StrEnum):
    """What scales with the uncertainty exponent."""

    PERTURBATION = "perturbation"
    BOXES = "boxes"
    ENTROPY = "entropy"


class Metric(StrEnum):
    """Distances between cells."""

    TAXICAB = "taxicab"
    CHESSBOARD = "chessboard"


def _option(name: str, default: Any, text: str) -> inspect.Parameter:
    """Option of an analysis; the bounds in the text are checked by `pipeline.products.derived`."""
    kind: Any = type(default)
    annotation = Annotated[kind, typer.Option(help=text)]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


ATTRACTOR_OPTIONS = (
    _option(
        "tolerance", 0.0,
        "Scaled distance (1 rad, 10 rad/s) within which a closed cell belongs to an orbit; 0 takes ten times "
        "the run's closure tolerance, at least 1e-4.",
    ),
    _option("polish", True, "Refine orbits by Newton's method, which integrates a point per orbit."),
    _option("residual", 1e-10, "Scaled residual that Newton's method is to reach; above 0."),
    _option("max_orbit_period", 16, "Longest period guessed for cells that are not closed; 1 or more."),
    _option("n_points", 64, "Section points stored per attractor; 1 or more."),
    _option("mirror_threshold", 0.3, "Largest distance of a mirror partner from the image; above 0."),
    _option("rule_box", 0.1, "Bounded sets: scaled side of the boxes that are compared; above 0."),
    _option("rule_same_share", 0.5, "Bounded sets: least share of boxes in common; above 0, at most 1."),
    _option("rule_rotation", 0.2, "Bounded sets: largest difference of rotation, turns per period."),
    _option("rule_n_anchors", 192, "Bounded sets: cells compared with each other in a round; 1 or more."),
    _option("rule_n_rounds", 4, "Bounded sets: rounds; 1 or more."),
    _option("threshold", 0.3, "Matching: largest distance between appearances of one id; above 0."),
    _option("look_back", 3, "Matching: steps over which an id is remembered; 1 or more."),
)  # fmt: skip

BASIN_OPTIONS = (
    _option("interval", Interval.WILSON, "Confidence interval of the fractions."),
    _option("confidence", 0.95, "Level of all intervals; between 0 and 1."),
    _option("box", 5, "Basin entropy: side of the boxes \\[cells]; 2 or more."),
    _option("block", 1, "Basin entropy: side of the squares of boxes that the bootstrap draws; 1 or more."),
    _option("scaling", Scaling.PERTURBATION, "Uncertainty exponent: what scales."),
    _option("radius", 1, "Wada test: radius of the fattened boundary \\[cells]; 1 or more."),
    _option("metric", Metric.TAXICAB, "Wada test: distance between cells."),
    _option("resamples", 200, "Samples of each bootstrap; 2 or more."),
    _option("seed", 0, "Seed of the bootstraps."),
)

SETTLING_OPTIONS = (
    _option("n_sample", 32, "Cells of each bounded set that are run on; 1 or more."),
    _option("n_periods", 1024, "Drive periods that they are run on; 1 or more."),
    _option("confidence", 0.95, "Level of the intervals; between 0 and 1."),
    _option("rtol", 0.0, "Relative tolerance; 0 takes that of the run."),
    _option("atol", 0.0, "Absolute tolerance; 0 takes that of the run."),
)

CHAOS_OPTIONS = (
    _option("n_sigma", 3.0, "Standard errors by which an exponent differs from 0; above 0."),
    _option("least", 0.005, "Least modulus of an exponent that differs from 0 \\[1/s]; 0 or more."),
    _option("n_frequencies", 100, "0-1 test: number of frequencies; 10 or more."),
    _option("stride", 1, "0-1 test: use every so many-th section; 1 or more."),
    _option("seed", 0, "0-1 test: seed of the frequencies; 0 or more."),
)

DIMENSION_OPTIONS = (
    _option("theiler", 1, "Pairs of sections at most so far apart in time are left out; 0 or more."),
    _option("n_max", 10_000, "Most section points used of a parameter point; 100 or more."),
    _option("floor", 1e-6, "Scaled distance (1 rad, 10 rad/s) that is not resolved; above 0."),
)


def takes(*options: inspect.Parameter) -> Callable[[F], F]:
    """Give a command that has ``**options`` these options by name."""

    def decorate(function: F) -> F:
        own = inspect.signature(function, eval_str=True)
        kept = [p for p in own.parameters.values() if p.kind is not inspect.Parameter.VAR_KEYWORD]
        command: Any = function
        command.__signature__ = own.replace(parameters=[*kept, *options])
        command.__annotations__ = {p.name: p.annotation for p in (*kept, *options)}
        return function

    return decorate


Csv = Annotated[Path | None, typer.Option("--csv", metavar="FILE", help="Write the table as CSV, too.")]


@analyse_app.callback()
def _directory(context: typer.Context, directory: Directory) -> None:
    context.obj = directory


@analyse_app.command(epilog=EXIT_HELP)
@takes(*ATTRACTOR_OPTIONS)
def attractors(context: typer.Context, csv: Csv = None, **options: Any) -> None:
    """Find the attractors at every parameter point, and follow them along the axes.

    A table per parameter point, or with more than six points a line per attractor with the range in
    which it exists. Shares are those of the cells whose outcome is known, with 95 % intervals.
    """
    from pipeline.products import derived
    from pipeline.products import tables as report

    ds = _derive(context, derived.attractors, csv, options)
    with refusals(context.obj):
        rows = report.attractor_rows(ds)
        _tell(report.attractor_lines(ds, rows), rows, csv, ds)


@analyse_app.command(epilog=EXIT_HELP)
@takes(*BASIN_OPTIONS, *ATTRACTOR_OPTIONS)
def basins(context: typer.Context, csv: Csv = None, **options: Any) -> None:
    """Measure the basins of a sweep: fractions with intervals, entropy, uncertainty exponent, Wada test.

    The last three need starts on a grid.
    """
    from pipeline.products import derived
    from pipeline.products import tables as report

    ds = _derive(context, derived.basins, csv, options)
    with refusals(context.obj):
        rows = report.basin_rows(ds)
        _tell(report.basin_lines(ds, rows), rows, csv, ds)


@analyse_app.command(epilog=EXIT_HELP)
@takes(*ATTRACTOR_OPTIONS)
def hysteresis(context: typer.Context, csv: Csv = None, **options: Any) -> None:
    """Say where a continuation meets other attractors going up than going down, and where it jumps."""
    from pipeline.products import derived
    from pipeline.products import tables as report

    ds = _derive(context, derived.hysteresis, csv, options)
    rows = report.jump_rows(ds)
    _tell(report.hysteresis_lines(ds, rows), rows, csv, ds)


@analyse_app.command(epilog=EXIT_HELP)
@takes(*SETTLING_OPTIONS, *ATTRACTOR_OPTIONS)
def settling(context: typer.Context, csv: Csv = None, **options: Any) -> None:
    """Run a sample of every bounded set on: does it stay, or was it a transient, and where does it go?

    This integrates, for minutes if there are many sets. Lifetimes are in drive periods.
    """
    from pipeline.products import derived
    from pipeline.products import tables as report

    ds = _derive(context, derived.settling, csv, options)
    rows = report.settling_rows(ds)
    _tell(report.settling_lines(ds, rows), rows, csv, ds)


@analyse_app.command(epilog=EXIT_HELP)
@takes(*CHAOS_OPTIONS)
def chaos(context: typer.Context, csv: Csv = None, **options: Any) -> None:
    """Tell regular from chaotic cells: mean Lyapunov exponents, Kaplan-Yorke dimension, 0-1 test.

    A table per parameter point, or with more than six points the ranges in which each kind of motion
    occurs. Exponents need [products] lyapunov in the run's specification, the 0-1 test 200 sections.
    """
    from pipeline.products import derived
    from pipeline.products import tables as report

    ds = _derive(context, derived.chaos, csv, options)
    rows = report.chaos_rows(ds)
    _tell(report.chaos_lines(ds, rows), rows, csv, ds)


@analyse_app.command(epilog=EXIT_HELP)
@takes(*DIMENSION_OPTIONS)
def dimension(
    context: typer.Context,
    at: Annotated[
        list[str] | None,
        typer.Option("--at", metavar="AXIS=VALUE", help="Value of a swept parameter; by default all."),
    ] = None,
    csv: Csv = None,
    **options: Any,
) -> None:
    """Measure the correlation dimension of the chaotic sections of a parameter point, pooled.

    Takes seconds per point, and thousands of sections for two digits.
    """
    from pipeline.products import derived
    from pipeline.products import tables as report

    chosen = read_pairs("--at", at or [], "frequency=2.4")
    ds = _derive(context, derived.dimension, csv, {"at": chosen, **options})
    rows = report.dimension_rows(ds)
    _tell(report.dimension_lines(ds, rows), rows, csv, ds)


@analyse_app.command(epilog=EXIT_HELP)
def prune(
    context: typer.Context,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="List them; remove nothing.")] = False,
) -> None:
    """Remove results of an earlier state of the cube or an earlier version of magpend."""
    from pipeline.products import derived

    found = (derived.stale if dry_run else derived.prune)(context.obj)
    for path in found:
        typer.echo(f"{'stale' if dry_run else 'removed'}: {path}")
    if not found:
        typer.echo("nothing to remove")


def _derive(
    context: typer.Context, product: Callable[..., xr.Dataset], csv: Path | None, options: dict[str, Any]
) -> xr.Dataset:
    from pipeline.spec.problems import SpecError

    if csv is not None and (csv.is_dir() or not csv.parent.is_dir()):
        raise SpecError([f"--csv {csv}: must be a file in a folder that exists."])
    return product(context.obj, echo=typer.echo, **options)


def _tell(lines: list[str], rows: list[dict[str, Any]], csv: Path | None, ds: xr.Dataset) -> None:
    from pipeline.products import tables as report

    for line in lines:
        typer.echo(line)
    if csv is not None:
        typer.echo(f"table: {report.write_csv(rows, csv)}")
    if "source" in ds.encoding:
        typer.echo(f"stored: {ds.encoding['source']}")
