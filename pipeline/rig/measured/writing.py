"""Write the comparison of a measured with a computed diagram to files: figures, tables, data."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from pipeline.layout.writing import write_atomically
from pipeline.plots.figure import save_data, save_figure
from pipeline.plots.style import WIDE, Frame
from pipeline.rig.measured.computed import Computed
from pipeline.rig.measured.figures import plot_comparison, plot_measured
from pipeline.rig.measured.tables import edges_table, steps_table
from pipeline.store.local import make_folder


def write_comparison(
    compared: xr.Dataset,
    computed: Computed,
    folder: Path,
    *,
    state: str = "",
    degrees: bool = False,
    frame: Frame = WIDE,
) -> list[Path]:
    """Write the figures and tables of the comparison of a measured with a computed diagram; return their paths.

    Parameters
    ----------
    compared
        Result of `pipeline.rig.measured.compare.compare_with`.
    computed
        Attractors that it was compared with.
    folder
        Folder, which is made if necessary; files of an earlier comparison are replaced.
    state, degrees, frame
        Options of the figures.

    Returns
    -------
    list of Path
        ``comparison``, ``beside`` and ``over`` as ``.png`` with their data as ``.nc``, ``steps.csv`` and
        ``edges.csv``.
    """
    figures = {
        "comparison": plot_comparison(compared, computed, state=state, degrees=degrees, frame=frame),
        "beside": plot_measured(compared, computed.cube, state=state, degrees=degrees, frame=frame),
        "over": plot_measured(compared, computed.cube, state=state, degrees=degrees, layout="over", frame=frame),
    }
    make_folder(folder)
    written = []
    for name, figure in figures.items():
        figure.data = figure.data.assign_attrs(run=computed.title, cube_digest=computed.digest)
        written += [save_figure(figure, folder / f"{name}.png"), save_data(figure, folder / f"{name}.nc")]
    for name, table in (("steps", steps_table(compared)), ("edges", edges_table(compared))):
        written.append(folder / f"{name}.csv")
        write_atomically(written[-1], table.csv())
    return written
