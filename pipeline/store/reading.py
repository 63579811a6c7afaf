"""Open a run directory as a labelled dataset."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.layout.attributes import netcdf_safe
from pipeline.layout.cells import DIRECTION_CODES
from pipeline.layout.vocabulary import model_attribute, section_attributes
from pipeline.store.parallel_reads import quick_reading
from pipeline.store.run import Run
from pipeline.store.view import committed_view

if TYPE_CHECKING:
    import xarray as xr


def open_run(path: str | Path | Run, *, chunks: Any = None, check: bool | None = None) -> xr.Dataset:
    """Open a run directory; only coordinates are read until variables are used.

    Cells that are not committed read as pending: ``status`` 0, ``section`` NaN. Open the run again to see
    cells that were committed later.

    Parameters
    ----------
    path
        Run directory.
    chunks
        As in `xarray.open_zarr`: None indexes lazily and loads what is selected; ``{}`` makes dask
        arrays in the chunks of the store, for cubes larger than the memory.
    check
        Whether every chunk is compared with the sha256 in its commit record when it is read. The default is
        True, unless the environment has ``MAGPEND_VERIFY=0``.

    Returns
    -------
    xarray.Dataset
        The cube. Its attributes hold the model's name, the specification's TOML text, the settings of the
        integration by name, those of products as ``<product>_<name>`` (such as ``lyapunov_n_periods``), and
        the provenance (``source``, ``created``, ``host``, ``git_commit``). It can be written as NetCDF.

    Raises
    ------
    RefusedError
        If there is no run in `path`.
    DamagedError
        If ``run.json``, metadata or coordinates have changed since they were written. When a cell is used
        later: if its chunk is missing or has changed.

    Examples
    --------
    >>> ds = open_run("runs/quickstart")                                    # doctest: +SKIP
    >>> ds.section.isel(state=0).sel(frequency=2.2, method="nearest")       # doctest: +SKIP
    """
    return Run.open(path).cube(chunks, check=check)


def cube_of(run: Run, *, chunks: Any = None, check: bool | None = None) -> xr.Dataset:
    """Return the cube of an opened run; cells without a commit record read as pending."""
    import xarray as xr

    view: Any = committed_view(run.info, run.plan, run.commits, check=check)
    with quick_reading():
        ds = xr.open_dataset(view, engine="zarr", chunks=chunks, consolidated=False, mask_and_scale=False)
    ds = ds[[v.name for v in run.plan.variables]]
    words = {str(name): _texts(ds[name]) for name in ds.coords if ds[name].dtype.kind not in "biuf"}
    ds = ds.assign_coords(words)
    if "direction" in ds.coords:
        ds = ds.assign_coords(direction=_directions(ds.coords["direction"]))
    return netcdf_safe(ds.assign_attrs(_attributes(run)))


def _attributes(run: Run) -> dict[str, Any]:
    """Return the attributes of an opened cube."""
    info = run.info
    attrs: dict[str, Any] = {
        "title": info.title,
        "source": f"magpend {info.versions.get('magpend', '(not installed)')}, "
        f"kernel {info.identity['kernel_version']}",
        **info.provenance,
        "kind": run.plan.kind,
        "model": model_attribute(run.spec.model),
        "spec": info.spec_text,
        "digest": info.digest,
        "parameters": "\n".join(f"{k} = {v!r}" for k, v in info.identity["parameter_values"].items()),
        **section_attributes(run.model.crossing),
        **run.spec.integration.model_dump(),
        **{f"{name}_{k}": v for name, o in run.spec.products.items() for k, v in o.plain().items()},
    }
    if run.plan.path is not None:
        attrs["path"] = run.plan.dims[run.plan.path]
    return attrs


def _texts(labels: xr.DataArray) -> Any:
    """Convert labels to a numpy dtype that every writer accepts."""
    return (labels.dims, np.array(labels.values.tolist(), dtype=str), labels.attrs)


def _directions(direction: xr.DataArray) -> Any:
    words = {code: word for word, code in DIRECTION_CODES.items()}
    values = np.array([words[int(code)] for code in direction.values])
    return ("branch", values, {"long_name": direction.attrs["long_name"]})
