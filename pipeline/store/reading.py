"""Open a run directory as a labelled dataset."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.layout.cells import DIRECTION_CODES
from pipeline.layout.plan import Plan, make_plan
from pipeline.products.registry import CELL_PRODUCTS
from pipeline.spec.parsing import Spec, parse_spec
from pipeline.store import directory as store

if TYPE_CHECKING:
    import xarray as xr


def open_run(path: str | Path, *, chunks: Any = None) -> xr.Dataset:
    """Open a run directory; nothing but coordinates is read until it is used.

    Cells that are not committed read as pending: ``status`` 0, ``section`` NaN. What is committed
    later shows after opening again.

    Parameters
    ----------
    path
        Run directory.
    chunks
        As in `xarray.open_zarr`: None indexes lazily and loads what is selected; ``{}`` makes dask
        arrays in the chunks of the store, for cubes larger than the memory.

    Returns
    -------
    xarray.Dataset
        With the specification's TOML text, the settings of the integration by name, those of the
        exponents as ``lyapunov_<name>``, and the versions that made it in the attributes.

    Raises
    ------
    store.RefusedError
        If there is no run in `path`.

    Examples
    --------
    >>> ds = open_run("runs/quickstart")                                    # doctest: +SKIP
    >>> ds.section.sel(state="psi1").sel(frequency=2.2, method="nearest")   # doctest: +SKIP
    """
    info = store.read_run(Path(path))
    return open_committed(info, make_plan(parse_spec(info.spec)), chunks=chunks)


def open_committed(
    info: store.RunInfo,
    plan: Plan,
    commits: Mapping[int, store.Commit] | None = None,
    *,
    chunks: Any = None,
) -> xr.Dataset:
    """As `open_run`, showing what `commits` vouch for; by default all that is committed now."""
    import xarray as xr

    view: Any = store.committed_view(info, plan, commits)
    ds = xr.open_dataset(view, engine="zarr", chunks=chunks, consolidated=False, mask_and_scale=False)
    names = [v.name for v in plan.variables]
    ds = ds.set_coords([name for name in ds.data_vars if name not in names])
    spec = parse_spec(info.spec)
    ds = ds[names].assign_coords(_labels(spec))
    if "direction" in ds.coords:
        ds = ds.assign_coords(direction=_words(ds.coords["direction"]))
    version = info.versions.get("magpend", "(not installed)")
    attrs: dict[str, Any] = {
        "title": info.title,
        "source": f"magpend {version}, kernel {info.identity['kernel_version']}",
        "kind": plan.kind,
        "model": spec.model_name,
        "spec": info.spec_text,
        "digest": info.digest,
        "parameters": "\n".join(f"{k} = {v!r}" for k, v in info.identity["parameter_values"].items()),
        # numbers only: netCDF knows no truth values
        **{name: int(v) if isinstance(v, bool) else v for name, v in spec.integration.model_dump().items()},
        **{f"{name}_{k}": v for name, o in spec.products.items() for k, v in o.plain().items()},
    }
    if plan.path is not None:
        attrs["path"] = plan.dims[plan.path]
    return ds.assign_attrs(attrs)


def _labels(spec: Spec) -> dict[str, Any]:
    """Return the names along the dims that are not cell dims."""
    model = spec.model
    labels: dict[str, Any] = {
        "state": ("state", list(model.state_names), {"long_name": "component of the state"}),
        "state_units": ("state", list(model.state_units), {"long_name": "unit of the component"}),
    }
    if model.angles:
        labels[model.angle_dim] = (model.angle_dim, list(model.angles), {"long_name": "by its angle"})
    for name, options in spec.products.items():
        for dim, values in CELL_PRODUCTS[name].coordinates(options, model).items():
            labels[dim] = (dim, list(values))
    return labels


def _words(direction: xr.DataArray) -> Any:
    words = {code: word for word, code in DIRECTION_CODES.items()}
    values = np.array([words[int(code)] for code in direction.values])
    return ("branch", values, {"long_name": direction.attrs["long_name"]})
