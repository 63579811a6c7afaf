"""Compute an analysis of a run, and print its table; for ``magpend analyse`` and ``magpend run --analyse``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.cli import console
from pipeline.cli.common import tell

if TYPE_CHECKING:
    from pipeline.compute.clients import Where


def show(
    directory: str,
    name: str,
    options: Any,
    workers: int | None,
    where: Where,
    csv: str | None = None,
    json: str | None = None,
) -> None:
    """Compute an analysis, or read it if it is stored, and print its table."""
    from pipeline.products.product import function_of
    from pipeline.products.registry import ANALYSES
    from pipeline.runs.derive import derive
    from pipeline.specification.problems import SpecError

    ds = derive(directory, name, options, echo=console.note, workers=workers, scheduler=where)
    table = function_of(ANALYSES[name].table)(ds)
    if table.nothing:
        raise SpecError(f"{directory}: {table.nothing}")
    tell(table, csv, json)
    if "source" in ds.encoding:
        console.note(f"stored: {ds.encoding['source']}")
