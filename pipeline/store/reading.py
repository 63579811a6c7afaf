"""Open a run's result cube as a labelled xarray dataset, and read the cells of single tasks."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numcodecs.blosc
import numpy as np
import zarr
from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec
from zarr.registry import get_pipeline_class, register_pipeline
from zarr.storage import StorePath

from pipeline.layout.cells import DIRECTION_CODES
from pipeline.layout.conventions import conventional, netcdf_safe
from pipeline.layout.identity import numbered
from pipeline.layout.own_words import rate_attribute
from pipeline.layout.vocabulary import (
    drift_attributes,
    model_attribute,
    noise_attributes,
    overrides_attribute,
    section_attributes,
)
from pipeline.store.commits import read_commit
from pipeline.store.declared import METADATA, consolidated_metadata
from pipeline.store.errors import IncompleteError
from pipeline.store.records import Commit
from pipeline.store.runfile import RunInfo
from pipeline.store.view import CommittedStore, committed_view

if TYPE_CHECKING:
    import xarray as xr


def cube_of(
    info: RunInfo,
    commits: Mapping[int, Commit],
    known: Mapping[str, bytes],
    *,
    chunks: Any = None,
    check: bool | None = None,
) -> xr.Dataset:
    """Return the result cube of a run as a dataset; cells without a commit record read as pending.

    Contents of files in `known` were compared already.
    """
    import xarray as xr

    view: Any = committed_view(info, commits, check=check, known=known)
    copies = consolidated_metadata(known.get(METADATA, b""))
    whole = all(name in copies for name in view.arrays())
    with quick_reading():
        ds = xr.open_dataset(view, engine="zarr", chunks=chunks, consolidated=whole, mask_and_scale=False)
    ds = ds[[v.name for v in info.plan.variables]]
    words = {str(name): _texts(ds[name]) for name in ds.coords if ds[name].dtype.kind not in "biuf"}
    ds = ds.assign_coords(words)
    if "direction" in ds.coords:
        ds = ds.assign_coords(direction=_directions(ds.coords["direction"]))
    return conventional(netcdf_safe(ds.assign_attrs(_attributes(info))))


def _attributes(info: RunInfo) -> dict[str, Any]:
    """Return the attributes of a run's result cube: title, model, specification, settings and provenance."""
    spec, dims, path = info.plan.spec, info.plan.dims, info.plan.path
    attrs: dict[str, Any] = {
        "title": info.title,
        "source": f"magpend {info.versions.get('magpend', '(not installed)')}, "
        f"engine {numbered(info.identity)['versions']['engine']}",
        **info.provenance,
        "kind": spec.kind,
        "model": model_attribute(spec.model),
        "spec": info.spec_text,
        "digest": info.digest,
        "parameters": "\n".join(f"{k} = {v!r}" for k, v in info.identity["parameter_values"].items()),
        **overrides_attribute(spec.parameters.overrides),
        **rate_attribute(spec.rate),
        **section_attributes(spec.model.crossing),
        **drift_attributes(spec.model),
        **noise_attributes(spec.model.disturbance),
        **spec.integration.model_dump(),
        **{f"{name}_{k}": v for name, o in spec.products.items() for k, v in o.plain().items()},
    }
    if path is not None:
        attrs["path"] = dims[path]
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


def read_cells(info: RunInfo, index: int, region: tuple[slice, ...], names: Iterable[str]) -> dict[str, np.ndarray]:
    """Read variables of some cells of a committed task, in slices of the cell dims that lie in the task's block.

    Raise `IncompleteError` if the task is not committed here, `UnreadableError` if its record cannot be read, and
    `DamagedError` if the content of a chunk has changed since it was written.
    """
    commit = read_commit(info, index)
    if commit is None:
        raise IncompleteError(
            f"{info.name}: task {index}, from which another goes on, is not committed here. Every "
            "worker must see this very folder, by this path; then give the same command again."
        )
    return read_block(info, commit, names, region)


def read_block(
    info: RunInfo, commit: Commit, names: Iterable[str], region: tuple[slice, ...] | None = None
) -> dict[str, np.ndarray]:
    """Read variables of one committed task, by default of all its cells. The dims of the cells come first, then the
    variable's.

    Raise `DamagedError` if the content of a chunk has changed since it was written.
    """
    region = info.plan.task(commit.task) if region is None else region
    view = committed_view(info, {commit.task: commit}, check=True)
    return {name: np.asarray(zarr.open_array(view, path=name, mode="r")[region]) for name in names}
