"""Write the posterior of an identification, and the bands of its diagrams, to its directory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

from pipeline.analysis.draws import LEVELS
from pipeline.layout.writing import write_netcdf
from pipeline.plots.figure import save_data, save_figure
from pipeline.products.product import Table
from pipeline.rig.identify.bands import bands, bands_table, stored_tables, tubes
from pipeline.rig.identify.directory import POSTERIOR, read_result
from pipeline.rig.identify.measured_orbits import MeasuredTable
from pipeline.rig.identify.posterior import Echo, Sampling, draw_posterior, posterior_table, sample_draws
from pipeline.rig.measured_branch.figure import Bands, plot_branch
from pipeline.runs.stopping import stoppable
from pipeline.store.files import FIGURES, local_path
from pipeline.store.local import make_folder, refuse_links, writer_lock

SHORT = {"period_doubling": "doubling", "neimark_sacker": "torus", "hopf": "Hopf"}
"""Names of bifurcations in figures."""


def write_posterior(
    directory: str | Path,
    n: int,
    seed: int = 1,
    *,
    sampling: Sampling | None = None,
    figures: bool = True,
    echo: Echo = print,
) -> tuple[Table, Table, list[Path]]:
    """Draw the posterior, compute the 95 % bands of branches and bifurcations, and write both to the identification's
    directory.

    Parameters
    ----------
    directory
        Directory of a finished identification.
    n, seed
        Number of draws, and their seed.
    sampling
        Options of the chain that gives the draws; None for draws of the Gaussian.
    figures
        Whether to draw.
    echo
        Function that prints a line.

    Returns
    -------
    tuple of Table, Table, list of Path
        Parameters, bifurcations, and the written files.

    Raises
    ------
    SpecError, RefusedError
        See `draw_posterior` and `sample_draws`.
    InterruptedRunError
        After Ctrl-C or SIGTERM. The chain stays.
    """
    folder = local_path(directory)
    result, found, written = read_result(folder), [], [folder / POSTERIOR]
    with writer_lock(folder), stoppable(folder):
        if sampling is None:
            drawn = draw_posterior(folder, n, seed)
        else:
            drawn = sample_draws(folder, n, seed, sampling, echo=echo)
        write_netcdf(written[0], drawn)
        for i, table in enumerate(stored_tables(folder)):
            one = bands(table, result["values"], drawn)
            found.append(one)
            written.append(folder / f"bands-{i}.nc")
            write_netcdf(written[-1], one.assign(kind=("bifurcation", one["kind"].values.astype(str))))
            if figures and table.measured is not None:
                written += _draw(folder, i, table, result["values"], one)
    return posterior_table(drawn), bands_table(found), written


def _draw(folder: Path, i: int, table: MeasuredTable, values: dict[str, float], found: xr.Dataset) -> list[Path]:
    branches, computed = table.branches(values)
    intervals = []
    for b in range(found.sizes["bifurcation"]):
        known = found["bifurcation_value"].values[:, b]
        known = known[np.isfinite(known)]
        if 2 * len(known) >= found.sizes["draw"]:
            kind = str(found["kind"].values[b])
            low, _, high = np.quantile(known, LEVELS)
            intervals.append((SHORT.get(kind, kind), float(low), float(high)))
    assert table.measured is not None
    figure = plot_branch(table.measured, branches, computed, bands=Bands(tubes(found), intervals))
    refuse_links(folder / FIGURES)
    make_folder(folder / FIGURES)
    path = folder / FIGURES / f"bands-{i}.png"
    return [save_figure(figure, path), save_data(figure, path)]
