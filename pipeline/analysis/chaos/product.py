"""Chaos and correlation dimension as analyses of a run (`pipeline.products.chaos`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import xarray as xr

from pipeline.products.chaos import ChaosOptions, DimensionOptions
from pipeline.products.product import Table

if TYPE_CHECKING:
    from pipeline.store.run import Run


def needs_chaos(run: Run, options: ChaosOptions) -> None:
    """Refuse a cube that has neither exponents nor sections enough."""
    from pipeline.analysis.chaos.chaos import check_chaos

    check_chaos(run.cube(), **options.plain())


def chaos(run: Run, options: ChaosOptions) -> xr.Dataset:
    """Exponents, dimension and 0-1 test of the cells, and their means by kind of motion."""
    from pipeline.analysis.chaos.chaos import chaos as compute

    return compute(run.cube(), **options.plain())


def chaos_table(ds: xr.Dataset) -> Table:
    """Table of the kinds of motion."""
    from pipeline.analysis import tables

    rows = tables.chaos_rows(ds)
    return Table(rows, tables.chaos_lines(ds, rows))


def needs_dimension(run: Run, options: DimensionOptions) -> None:
    """Refuse axes and values that the cube does not have."""
    from pipeline.analysis.chaos.chaos import check_dimension

    check_dimension(run.cube(), **options.plain())


def settle_dimension(run: Run, options: DimensionOptions) -> DimensionOptions:
    """Take the values that the axes have: another spelling of a point is the same result."""
    from pipeline.analysis.selection import select_points

    part = select_points(run.cube(), options.at)
    return options.model_copy(update={"at": {name: float(part[name].values[0]) for name in options.at}})


def dimension(run: Run, options: DimensionOptions) -> xr.Dataset:
    """Correlation dimension of the chaotic sections of each parameter point."""
    from pipeline.analysis.chaos.chaos import section_dimension

    return section_dimension(run.cube(), **options.plain())


def dimension_table(ds: xr.Dataset) -> Table:
    """Table of the dimensions."""
    from pipeline.analysis import tables

    rows = tables.dimension_rows(ds)
    return Table(rows, tables.dimension_lines(ds, rows))
