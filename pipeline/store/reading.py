"""Open a run's result cube as a labelled xarray dataset, and read the cells of single tasks."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Protocol

import numcodecs.blosc
import numpy as np
import zarr
from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec
from zarr.registry import get_pipeline_class, register_pipeline
from zarr.storage import StorePath

from magpend_core.models.model import Model
from pipeline.layout.cells import DIRECTION_CODES
from pipeline.layout.conventions import conventional, netcdf_safe
from pipeline.layout.identity import numbered
from pipeline.layout.own_words import rate_attribute
from pipeline.layout.plan import Plan
from pipeline.layout.vocabulary import (
    drift_attributes,
    model_attribute,
    noise_attributes,
    overrides_attribute,
    section_attributes,
)
from pipeline.specification.spec import Spec
from pipeline.store.arrays import METADATA, consolidated_metadata
from pipeline.store.commits import read_commit
from pipeline.store.errors import IncompleteError
from pipeline.store.records import Commit
from pipeline.store.runfile import RunInfo
from pipeline.store.view import CommittedStore, committed_view

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
        **rate_attribute(run.spec.rate),
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


# ---- many small chunks -----------------------------------------------------------------------------

_CHAIN = (BytesCodec, BloscCodec, Crc32cCodec)
_BATCH = 200
_CHECKSUM_BYTES = 4


_Registered: Any = get_pipeline_class()


class QuickPipeline(_Registered):  # type: ignore[misc]
    """A codec pipeline for zarr that reads small chunks of a `CommittedStore` in a local folder faster, in threads."""

    async def read(self, batch_info: Iterable[Any], out: Any, drop_axes: tuple[int, ...] = ()) -> None:
        """Read and decode chunks into `out`; see `zarr.abc.codec.CodecPipeline.read`."""
        items = list(batch_info)
        if len(items) > 1 and not drop_axes and _codecs_of(self) == _CHAIN:
            target = out.as_ndarray_like()
            batches = [items[i : i + _BATCH] for i in range(0, len(items), _BATCH)]
            # threads, so that a disk or a server is asked for many files at a time
            left = await asyncio.gather(*(asyncio.to_thread(_put_all, batch, target) for batch in batches))
            items = [item for batch in left for item in batch]
        if items:
            await super().read(items, out, drop_axes)


def _codecs_of(pipeline: Any) -> tuple[type, ...]:
    return tuple(type(codec) for codec in pipeline) if isinstance(pipeline, Iterable) else ()


def _put_all(items: list[Any], target: np.ndarray) -> list[Any]:
    return [item for item in items if not _put(item, target)]


def _put(item: Any, target: np.ndarray) -> bool:
    place, spec, chunk_selection, selection, *_ = item
    if not (isinstance(place, StorePath) and isinstance(place.store, CommittedStore)):
        return False
    content = place.store.small_chunk(place.path)
    if content is None:
        return False
    # small_chunk has compared the chunk's crc32c
    data = numcodecs.blosc.decompress(content[:-_CHECKSUM_BYTES])
    dtype = spec.dtype.to_native_dtype().newbyteorder("<")
    target[selection] = np.frombuffer(data, dtype).reshape(spec.shape)[chunk_selection]
    return True


register_pipeline(QuickPipeline)


@contextlib.contextmanager
def quick_reading() -> Iterator[None]:
    """Use `QuickPipeline` for zarr arrays that are opened inside this context."""
    with zarr.config.set({"codec_pipeline.path": f"{QuickPipeline.__module__}.{QuickPipeline.__qualname__}"}):
        yield


# ---- cells of one task -----------------------------------------------------------------------------


def read_cells(
    info: RunInfo, plan: Plan, index: int, region: tuple[slice, ...], names: Iterable[str]
) -> dict[str, np.ndarray]:
    """Read variables of some cells of a committed task, in slices of the cell dims that lie in the task's block.

    Raise `IncompleteError` if the task is not committed here, `UnreadableError` if its record cannot be read, and
    `DamagedError` if the content of a chunk has changed since it was written.
    """
    commit = read_commit(info, plan, index)
    if commit is None:
        raise IncompleteError(
            f"{info.name}: task {index}, from which another goes on, is not committed here. Every "
            "worker must see this very folder, by this path; then give the same command again."
        )
    return _read(info, plan, index, commit, region, names)


def read_block(run: OpenedRun, index: int, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Read variables of one committed task of an open run. The dims of the task's block come first, then the
    variable's.

    Raise `DamagedError` if the content of a chunk has changed since it was written.
    """
    return _read(run.info, run.plan, index, run.commits[index], run.plan.task(index), names)


def _read(
    info: RunInfo, plan: Plan, index: int, commit: Commit, region: tuple[slice, ...], names: Iterable[str]
) -> dict[str, np.ndarray]:
    view = committed_view(info, plan, {index: commit}, check=True)
    return {name: np.asarray(zarr.open_array(view, path=name, mode="r")[region]) for name in names}
