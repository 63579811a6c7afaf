"""Open a run's result cube as a labelled xarray dataset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from magpend_core.models.model import Model
from pipeline.layout.cells import DIRECTION_CODES
from pipeline.layout.conventions import conventional, netcdf_safe
from pipeline.layout.identity import numbered
from pipeline.layout.plan import Plan
from pipeline.layout.vocabulary import (
    drift_attributes,
    model_attribute,
    noise_attributes,
    overrides_attribute,
    section_attributes,
)
from pipeline.specification.spec import Spec
from pipeline.store.declared import METADATA, consolidated_metadata
from pipeline.store.parallel_reads import quick_reading
from pipeline.store.records import Commit
from pipeline.store.runfile import RunInfo
from pipeline.store.view import committed_view

if TYPE_CHECKING:
    import xarray as xr


class OpenedRun(Protocol):
    """Interface to the parts of a run from which its result cube is made; see `pipeline.store.run.RunDirectory`."""

    @property
    def info(self) -> RunInfo: ...  # noqa: D102
    @property
    def plan(self) -> Plan: ...  # noqa: D102
    @property
    def commits(self) -> Mapping[int, Commit]: ...  # noqa: D102
    @property
    def spec(self) -> Spec: ...  # noqa: D102
    @property
    def model(self) -> Model: ...  # noqa: D102
    @property
    def known(self) -> Mapping[str, bytes]: ...  # noqa: D102


def cube_of(run: OpenedRun, *, chunks: Any = None, check: bool | None = None) -> xr.Dataset:
    """Return the result cube of an opened run as a dataset; cells without a commit record read as pending."""
    import xarray as xr

    view: Any = committed_view(run.info, run.plan, run.commits, check=check, known=run.known)
    copies = consolidated_metadata(run.known.get(METADATA, b""))
    whole = all(name in copies for name in view.arrays())
    with quick_reading():
        ds = xr.open_dataset(view, engine="zarr", chunks=chunks, consolidated=whole, mask_and_scale=False)
    ds = ds[[v.name for v in run.plan.variables]]
    words = {str(name): _texts(ds[name]) for name in ds.coords if ds[name].dtype.kind not in "biuf"}
    ds = ds.assign_coords(words)
    if "direction" in ds.coords:
        ds = ds.assign_coords(direction=_directions(ds.coords["direction"]))
    return conventional(netcdf_safe(ds.assign_attrs(_attributes(run))))


def _attributes(run: OpenedRun) -> dict[str, Any]:
    """Return the attributes of a run's result cube: title, model, specification, settings and provenance."""
    info = run.info
    attrs: dict[str, Any] = {
        "title": info.title,
        "source": f"magpend {info.versions.get('magpend', '(not installed)')}, "
        f"engine {numbered(info.identity)['versions']['engine']}",
        **info.provenance,
        "kind": run.plan.kind,
        "model": model_attribute(run.spec.model),
        "spec": info.spec_text,
        "digest": info.digest,
        "parameters": "\n".join(f"{k} = {v!r}" for k, v in info.identity["parameter_values"].items()),
        **overrides_attribute(run.spec.parameters.overrides),
        **section_attributes(run.model.crossing),
        **drift_attributes(run.model),
        **noise_attributes(run.model.disturbance),
        **run.spec.integration.model_dump(),
        **{f"{name}_{k}": v for name, o in run.spec.products.items() for k, v in o.plain().items()},
    }
    if run.plan.path is not None:
        attrs["path"] = run.plan.dims[run.plan.path]
    return attrs


def _texts(labels: xr.DataArray) -> Any:
    """Convert a coordinate of texts to a numpy dtype that every file writer accepts."""
    return (labels.dims, np.array(labels.values.tolist(), dtype=str), labels.attrs)


def _directions(direction: xr.DataArray) -> Any:
    words = {code: word for word, code in DIRECTION_CODES.items()}
    values = np.array([words[int(code)] for code in direction.values])
    return ("branch", values, {"long_name": direction.attrs["long_name"]})
