"""Register the accessor ``ds.magpend`` of xarray Datasets: cubes of runs, and results of analyses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

if TYPE_CHECKING:
    import pandas as pd

    from magpend._plots import Plots
    from magpend._runs import Run
    from magpend_core.models.model import Model, Parameters

_DERIVED = "/derived/"


@xr.register_dataset_accessor("magpend")  # type: ignore[no-untyped-call]
class DatasetAccessor:
    """Model, run, table and figures of a Dataset that magpend has made.

    Parameters
    ----------
    ds
        A cube of `magpend.open_run` or a part of it, or the result of an analysis.
    """

    def __init__(self, ds: xr.Dataset) -> None:
        self._ds = ds

    @property
    def model(self) -> Model:
        """Model that was integrated.

        Raises
        ------
        ValueError
            If the Dataset is none of magpend's.
        """
        from pipeline.layout.vocabulary import model_of

        return model_of(self._known())

    @property
    def parameters(self) -> Parameters:
        """Values of the model parameters that are not swept.

        Raises
        ------
        ValueError
            If the Dataset is none of magpend's.
        """
        from pipeline.layout.vocabulary import parameters_of

        return parameters_of(self._known())

    @property
    def plot(self) -> Plots:
        """Figures that need nothing but this cube, or the part of it that was selected.

        ``ds.magpend.plot.bifurcation()``, ``section``, ``lyapunov``, ``convergence`` and ``rotation`` draw cells.
        The other figures need analyses of the whole run: use ``run.plot``.

        Raises
        ------
        ValueError
            If the Dataset is no cube.
        """
        from magpend._plots import Plots

        return Plots(self._cube("plot"))

    def table(self) -> pd.DataFrame:
        """Return the result of an analysis as a pandas table; see `magpend.table`.

        Raises
        ------
        ValueError
            If the Dataset is not the result of an analysis with a table.
        """
        from magpend._runs import table

        return table(self._ds)

    def graph(self) -> dict[str, Any]:
        """Return the events of attractors as a graph, as ``magpend analyse events --json`` writes it.

        Returns
        -------
        dict
            Node-link data: ``nodes`` are attractors with one kind and period, with their range and basin fractions;
            ``edges`` are events, each with its ``sentence``.

        Raises
        ------
        ValueError
            If the Dataset is not the result of `magpend.events`.

        Examples
        --------
        >>> networkx.node_link_graph(run.events().magpend.graph(), edges="edges")         # doctest: +SKIP
        """
        from magpend._runs import shown
        from pipeline.layout.writing import json_value

        graph = shown(self._ds).graph
        if graph is None:
            raise ValueError("ds.magpend.graph: the Dataset is not the result of events.")
        return dict(json_value(graph))

    def save(self, path: str | Path) -> Path:
        """Write the Dataset to a file in the format of its name, such as ``result.mat``.

        Parameters
        ----------
        path
            ``*.nc`` (NetCDF), ``*.mat`` (MATLAB and Octave), ``*.csv`` (the table of an analysis, or a time series),
            ``b.*`` (branches as the table of AUTO), or ``*.dat`` (a time series from which AUTO starts).

        Returns
        -------
        Path
            The file written.

        Raises
        ------
        SpecError
            If the name has no format, the format holds no such Dataset, or the folder does not exist.

        Examples
        --------
        >>> run.cube().magpend.save("cube.mat")                                            # doctest: +SKIP
        """
        from pipeline.runs.exporting import save

        return save(self._ds, path)

    def orbit(self, branch: int, point: int, *, samples: int = 200) -> xr.Dataset:
        """Return the periodic orbit at a point of a branch, stable or not, as a time series over one period.

        Parameters
        ----------
        branch, point
            Place in the result of `magpend.branches`.
        samples
            Samples per drive period or return.

        Returns
        -------
        Dataset
            States and quantities over ``time``, as `magpend.simulate` returns them; both ends of the period included.

        Raises
        ------
        SpecError
            If there is no such point, if it is an equilibrium, or if this is no result of branches that a run keeps.

        Examples
        --------
        >>> run.branches().magpend.orbit(2, 5).magpend.save("ab.dat")                      # doctest: +SKIP
        """
        from pipeline.runs.auto_files import orbit

        return orbit(self._ds, branch, point, samples)

    def sets(self) -> xr.Dataset:
        """Return the sets of a result that has one row for each set at each parameter point.

        Returns
        -------
        Dataset
            Variables on the dim ``set``, with ``attractor_id`` and the swept parameters as coordinates along it. In a
            result of `magpend.attractors` the section points of the first row are the first ``n_points`` of
            ``attractor_points`` on the dim ``sample``, those of the next row follow (a contiguous ragged array of the
            CF conventions).

        Raises
        ------
        ValueError
            If the Dataset has no rows: `magpend.attractors`, `chaos`, `dimension` and `resilience` give them.

        Examples
        --------
        >>> run.attractors().magpend.sets().share.groupby("attractor_id").max()            # doctest: +SKIP
        """
        from pipeline.results.ragged import sets

        return sets(self._rows("sets"))

    def dense(self) -> xr.Dataset:
        """Return a result that has rows of sets with these on the swept parameters and the dim ``attractor``.

        It has room for each attractor at each parameter point, so that it is large where there are many of both.

        Returns
        -------
        Dataset
            ``attractor`` runs over the ids. Where a point lacks a set, ``kind`` is 0, counts and shares are 0, and
            other numbers NaN. Section points are on the dim ``point``.

        Raises
        ------
        ValueError
            If the Dataset has no rows: `magpend.attractors`, `chaos`, `dimension` and `resilience` give them.

        Examples
        --------
        >>> run.attractors().magpend.dense().share.plot()                                  # doctest: +SKIP
        """
        from pipeline.results.ragged import dense

        return dense(self._rows("dense"), points=True)

    def run(self) -> Run:
        """Open the run from whose directory the Dataset was read.

        Raises
        ------
        ValueError
            If the Dataset was not read from a run directory, or was computed from one that was.
        """
        from magpend._runs import Run

        source = str(self._known().encoding.get("source", ""))
        place = source.partition(_DERIVED)[0]
        if not place or ("derived_product" in self._ds.attrs) != (_DERIVED in source):
            raise ValueError(
                "ds.magpend.run: the Dataset was not read from a run directory, or was computed from one that was; "
                "open the run with magpend.Run.open(DIR)."
            )
        return Run.open(place)

    def counts(self) -> dict[str, int]:
        """Return the number of cells by status, such as ``periodic``, ``diverged`` or ``pending``.

        Raises
        ------
        ValueError
            If the Dataset is no cube.
        """
        from magpend_core.status import Status

        codes = self._cube("counts")["status"].values
        numbers = {status.name.lower(): int(np.count_nonzero(codes == status)) for status in Status}
        return {name: number for name, number in numbers.items() if number}

    def sel_cell(self, *, nearest: bool = False, **values: float) -> xr.Dataset:
        """Select cells by values on their axes, with the spellings that commands accept.

        Parameters
        ----------
        nearest
            Whether to take the nearest value of an axis. Otherwise a value must be on its axis, except for rounding.
        values
            Value by axis: ``frequency_hz``, ``omega`` or ``period``, a parameter, ``branch``, or for a grid of
            initial states the state, with ``_deg`` in degrees.

        Returns
        -------
        Dataset
            The cells, without the axes named.

        Raises
        ------
        ValueError
            If there is no such axis, or if a value is not on its axis; the message names the nearest ones.

        Examples
        --------
        >>> ds.magpend.sel_cell(frequency_hz=2.2, x_deg=20)                  # doctest: +SKIP
        """
        from pipeline.results.selection import place
        from pipeline.runs.naming import place as axis_of

        cube = self._cube("sel_cell")
        chosen: dict[str, int] = {}
        for name, given in values.items():
            axis, value = axis_of(cube, name, given)
            along = cube[axis]
            chosen[axis] = int(np.abs(along.values - value).argmin()) if nearest else place(along, value)
        return cube.isel(chosen)

    def _known(self) -> xr.Dataset:
        if "model" not in self._ds.attrs:
            raise ValueError(
                "ds.magpend: the Dataset has no attribute 'model', so it is no cube of magpend.open_run and no result "
                "of an analysis. Arithmetic drops attributes unless xarray.set_options(keep_attrs=True)."
            )
        return self._ds

    def _rows(self, name: str) -> xr.Dataset:
        from pipeline.results.ragged import is_ragged

        if not is_ragged(self._known()):
            what = self._ds.attrs.get("derived_product", "a cube")
            raise ValueError(
                f"ds.magpend.{name}: needs a result with rows of sets, of magpend.attractors, chaos, dimension or "
                f"resilience, and this is {what}."
            )
        return self._ds

    def _cube(self, name: str) -> xr.Dataset:
        if "status" not in self._known() or "derived_product" in self._ds.attrs:
            what = self._ds.attrs.get("derived_product", "another Dataset")
            raise ValueError(f"ds.magpend.{name}: needs a cube of magpend.open_run, and this is {what}.")
        return self._ds
