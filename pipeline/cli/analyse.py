"""Define ``magpend analyse NAME DIR``, with a command for each analysis in the registry."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from pipeline.cli import console
from pipeline.cli.common import Csv, Directory, Json, Saved, check_csv, check_saved
from pipeline.cli.groups import Groups, add_command, command_group, made, registry_group
from pipeline.cli.options import taking
from pipeline.cli.running import ClusterFile, Scheduler, Workers, show


def _groups() -> Groups:
    from pipeline.products.registry import ANALYSES

    return ANALYSES.groups


def _make(name: str) -> Any:
    from pipeline.products.registry import ANALYSES

    analysis = ANALYSES[name]

    def command(
        directory: Directory,
        options: Any,
        workers: Workers = None,
        scheduler: Scheduler = None,
        cluster: ClusterFile = None,
        csv: Csv = None,
        json: Json = None,
        out: Saved = None,
    ) -> None:
        from pipeline.compute.clients import Where

        check_csv(csv)
        check_saved(out)
        show(directory, name, options, workers, Where(scheduler, cluster), csv, json, out)

    command.__name__ = name
    return made(name, taking(analysis.options, command), analysis.help)


analyse_app = command_group(
    "Find attractors, basins, chaos and branches in a stored cube; results are kept in DIR/derived.",
    registry_group("analyse", _groups, _make),
)


def prune(
    directory: Directory,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="List the results; remove nothing.")] = False,
) -> None:
    """Remove results that belong to earlier cells, attractors or branches of the run, or to an earlier magpend."""
    from pipeline.runs import derive

    found = (derive.stale if dry_run else derive.prune)(directory)
    for path in found:
        console.result(f"{'stale' if dry_run else 'removed'}: {path}")
    if not found:
        console.result("nothing to remove")


add_command(analyse_app, prune)
