"""Define ``magpend extend``, which widens a run and reuses all computed cells (trajectories)."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from pipeline.cli import console
from pipeline.cli.common import Directory
from pipeline.cli.options import completing
from pipeline.cli.running import ClusterFile, Dashboard, DryRun, Scheduler, Workers, workflow_names


def extend(
    directory: Directory,
    spec: Annotated[
        str | None,
        typer.Argument(
            metavar="[SPEC]",
            help="Wider specification; by default that of DIR, changed by the options.",
            autocompletion=completing(workflow_names),
        ),
    ] = None,
    axis: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=LOW:HIGH:NUM", help="New range of the frequency, a parameter or a state."),
    ] = None,
    starts: Annotated[int | None, typer.Option(min=1, help="Number of random initial states.")] = None,
    keep: Annotated[int | None, typer.Option(min=1, help="Number of kept sections.")] = None,
    product: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[={...}]", help="Additional product, with options as in a specification's [products]."
        ),
    ] = None,
    also: Annotated[
        list[str] | None, typer.Option(metavar="DIR", help="Another run with cells to reuse, such as another half.")
    ] = None,
    out: Annotated[
        str | None, typer.Option(help="Directory of the wider run. Default: it replaces DIR when it is complete.")
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    cluster: ClusterFile = None,
    dashboard: Dashboard = False,
    dry_run: DryRun = False,
) -> None:
    """Widen the ranges of a run, or add products to it; computed cells (trajectories) are reused.

    The files are the same as those of a fresh run of the wider specification. You can stop the command at any
    time: the same command continues. Without --out the old run is kept as DIR.before.
    """
    from pipeline.runs import extend as extending
    from pipeline.runs.zoom import Widening

    changes: dict[str, Any] = {
        "axes": _axes(axis or []),
        "starts": starts,
        "keep": keep,
        "products": _products(product or []),
    }
    if dry_run:
        found = extending.plan_extension((directory, *(also or ())), spec, Widening(**changes))
        console.result(*extending.describe_extension(found, workers=workers))
        return
    state = extending.extend(
        directory,
        spec,
        out,
        also=also or (),
        **changes,
        workers=workers,
        scheduler=scheduler,
        cluster=cluster,
        dashboard=dashboard,
        echo=console.note,
    )
    console.result(f"cube: {state.info.files.below('cube.zarr').name}")


def _axes(texts: list[str]) -> dict[str, dict[str, Any]]:
    """Parse ``--axis`` texts, ``NAME=LOW:HIGH:NUM``, into ranges by axis name."""
    from pipeline.layout.vocabulary import parameter_name
    from pipeline.specification.problems import SpecError

    found, problems = {}, []
    for text in texts:
        name, _, values = text.partition("=")
        try:
            low, high, num = values.split(":")
            found[parameter_name(name.strip())] = {"start": float(low), "stop": float(high), "num": int(num)}
        except ValueError:
            problems.append(f"--axis {text}: must be NAME=LOW:HIGH:NUM, as in frequency_hz=2:3:201.")
    if problems:
        raise SpecError(problems)
    return found


def _products(texts: list[str]) -> dict[str, dict[str, Any]]:
    """Parse ``--product`` texts, ``NAME`` or ``NAME={key = value, ...}``, into options by product name."""
    import tomllib

    from pipeline.specification.problems import SpecError

    found, problems = {}, []
    for text in texts:
        name, _, options = text.partition("=")
        try:
            value = tomllib.loads(f"options = {options or '{}'}")["options"]
        except tomllib.TOMLDecodeError:
            value = None
        if isinstance(value, dict):
            found[name.strip()] = value
        else:
            problems.append(f"--product {text}: must be NAME or NAME={{...}}, as in 'lyapunov={{n_periods = 800}}'.")
    if problems:
        raise SpecError(problems)
    return found
