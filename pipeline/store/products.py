"""Write and read the results of analyses (products): whole or not at all, with a digest of their content.

Each product is a zarr group such as ``derived/attractors-1a2b3c4d.zarr``. Labels (``state``, ``direction``,
classes of motion) are stored as codes; the attribute ``words`` lists the labels.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import json
import time
import warnings
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.layout.conventions import netcdf_safe
from pipeline.layout.writing import TEMPORARY, sync_folder, temporary_beside, writing
from pipeline.store.declared import disagreements, product_problem
from pipeline.store.errors import DamagedError, UnreadableError
from pipeline.store.files import Files
from pipeline.store.local import files_below, refuse_links, remove_tree, sync
from pipeline.store.objects import open_files

if TYPE_CHECKING:
    import xarray as xr

SEAL = "content_sha256"
"""Attribute of a product: a digest of its other attributes and of all files but ``zarr.json``."""

BLOCKS = ".blocks"
"""End of the name of a folder with blocks of an unfinished product."""

_WORDS = "words"
_MOST_TRIES = 20
"""Times that a product in the way is removed before the new product is given up."""

_PRODUCT_CHUNK_BYTES = 16_000_000
_GROUP = "zarr.json"

Place = str | Path | Files
Digests = list[tuple[str, str]]


def write_product(place: Place, ds: xr.Dataset) -> None:
    """Write a dataset (the result of an analysis) to its path, whole or not at all.

    Labels are stored as codes, which the attribute ``words`` lists, since zarr format 3 has no strings of fixed length.
    If another process first puts a sound product with the same attributes there, that product stays.
    """
    files = open_files(place)
    if files.local is None:
        _put_product(files, ds)
        return
    path = files.local
    refuse_links(path.parent)
    temporary = temporary_beside(path)
    try:
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            data, attrs = _contents(ds)
            for key, content in data.items():
                (temporary / key).parent.mkdir(parents=True, exist_ok=True)
                (temporary / key).write_bytes(content)
            sync(files_below(temporary), temporary)
            read_product_attrs(temporary)  # the digest is of what was handed over: bytes changed on the way show
            _put_in_place(temporary, path, attrs)
            sync_folder(path.parent)
    finally:
        remove_tree(temporary)


def _put_product(files: Files, ds: xr.Dataset) -> None:
    """Write a product into an object store; ``zarr.json`` with the digest comes last and makes it valid."""
    data, attrs = _contents(ds)
    with contextlib.suppress(FileNotFoundError, DamagedError):
        if _own(read_product_attrs(files)) == attrs:
            return
    remove_product(files)
    for key in sorted(data, key=lambda key: (key == _GROUP, key)):
        files.write(key, data[key])


def open_product(place: Place, *, lazy: bool = False) -> xr.Dataset:
    """Read a product (the stored result of an analysis) into memory; with `lazy`, numbers are read when they are used.

    The content is compared with its digest now. Raise `FileNotFoundError` if there is none, and `DamagedError` if its
    content has changed since it was written.
    """
    import xarray as xr

    files = open_files(place)
    is_local = files.local is not None
    contents: dict[str, bytes] = {}
    if lazy and is_local:
        read_product_attrs(files)
    else:
        contents = _read_whole(files)
    try:
        # zarr takes longer to import than such a result to read
        ds = (
            _decoded(contents)
            if contents
            else xr.open_zarr(files.zarr(read_only=True), consolidated=False, chunks=None)
        )
        loaded = ds.assign(with_words(ds))
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError, OSError, RuntimeError) as error:
        # of zarr, blosc and xarray: metadata from a stranger may have any type
        raise DamagedError(f"{files.name}: {error}") from None
    variables = {name: loaded.variables[name] for name in sorted(map(str, loaded.data_vars))}
    return netcdf_safe(xr.Dataset(variables, loaded.coords, _own(loaded.attrs)))


def _decoded(contents: Mapping[str, bytes]) -> xr.Dataset:
    """Return the dataset in the files of a product by key, whose sizes and codecs `product_problem` has accepted."""
    import xarray as xr

    arrays = {
        key.partition("/")[0]: json.loads(contents[key]) for key in sorted(contents) if key.endswith(f"/{_GROUP}")
    }
    variables = {
        name: xr.Variable(about.get("dimension_names", ()), _array(name, about, contents), about["attributes"])
        for name, about in arrays.items()
    }
    attrs = json.loads(contents[_GROUP])["attributes"]
    names = attrs.pop("coordinates", "").split()
    return xr.Dataset(variables, attrs=attrs).set_coords(names)


def _array(name: str, about: Mapping[str, Any], contents: Mapping[str, bytes]) -> np.ndarray:
    """Return the array of a product that zarr's metadata `about` describe, from its chunks."""
    from numcodecs import blosc

    shape, chunk = about["shape"], about["chunk_grid"]["configuration"]["chunk_shape"]
    found = np.empty(shape, about["data_type"])
    stored = found.dtype.newbyteorder("<")
    for place in np.ndindex(*(-(-n // size) for n, size in zip(shape, chunk, strict=True))):
        # each chunk ends with the four bytes of its crc32c
        content = blosc.decompress(contents["/".join([name, ".".join(map(str, ("c", *place)))])][:-4])
        region = tuple(slice(i * size, min((i + 1) * size, n)) for i, size, n in zip(place, chunk, shape, strict=True))
        inside = tuple(slice(s.stop - s.start) for s in region)
        found[region] = np.frombuffer(content, stored).reshape(chunk)[inside]
    return found


def read_product_attrs(place: Place) -> dict[str, Any]:
    """Compare the files of a product (stored analysis result) with the digest in its attributes; return the attributes.

    Raise `FileNotFoundError` if there is none, and `DamagedError` if its content has changed since it was written.
    """
    files = open_files(place)
    if files.local is not None:
        with _reading(files):
            attrs = _sealed_attrs(files, files.read(_GROUP), _digests(files))
            _refuse_declared(files, files.read_each(files.everything()))
            return attrs
    keys = files.everything()
    group = dict(files.read_each([_GROUP] if keys else []))
    return _sealed_attrs(files, group.get(_GROUP), _digests(files))


def _read_whole(files: Files) -> dict[str, bytes]:
    """Read all files of a product, each once, and compare them as `read_product_attrs` does."""
    with _reading(files):
        contents = dict(files.read_each(files.everything()))
        _sealed_attrs(files, contents.get(_GROUP), _digests_of(contents.items()))
        _refuse_declared(files, contents.items())
    return {key: value for key, value in contents.items() if isinstance(value, bytes)}


@contextlib.contextmanager
def _reading(files: Files) -> Iterator[None]:
    """Raise `FileNotFoundError` if a product is not there, and `DamagedError` if it cannot be read."""
    path = files.local
    if path is not None and (path.is_symlink() or path.parent.is_symlink()):
        raise DamagedError(f"{path}: is, or lies behind, a link")
    if path is not None and not path.exists():
        raise FileNotFoundError(path)
    try:
        yield
    except (OSError, UnreadableError) as error:
        if path is None:
            raise
        raise DamagedError(f"{path}: {error!r}") from None


def _refuse_declared(files: Files, contents: Iterable[tuple[str, bytes | FileNotFoundError]]) -> None:
    metadata: dict[str, bytes] = {}

    def whole() -> Iterator[tuple[str, bytes]]:
        for key, value in contents:
            if isinstance(value, bytes):
                metadata.update({key: value} if key.endswith(_GROUP) else {})
                yield key, value

    problem = product_problem(whole()) or next(iter(disagreements(metadata)), None)
    if problem:
        raise DamagedError(f"{files.name}: {problem}")


def _sealed_attrs(files: Files, group: bytes | FileNotFoundError | None, digests: Digests) -> dict[str, Any]:
    if not isinstance(group, bytes):
        if digests:
            raise DamagedError(f"{files.name}: it has no {_GROUP}")
        raise FileNotFoundError(files.name)
    try:
        attrs: dict[str, Any] = json.loads(group)["attributes"]
        if attrs[SEAL] == _seal(attrs, digests):
            return attrs
    except (ValueError, KeyError, TypeError) as error:
        raise DamagedError(f"{files.name}: {error!r}") from None
    raise DamagedError(f"{files.name}: its content has changed")


def remove_product(place: Place) -> None:
    """Remove a product (stored analysis result) if it exists; remove a symbolic link, but not its target."""
    files = open_files(place)
    if files.local is None:
        keys = files.everything()
        files.remove(key for key in keys if key == _GROUP)  # goes first: without it the rest is not a product
        files.remove(key for key in keys if key != _GROUP)
        return
    path = files.local
    refuse_links(path.parent)
    aside = temporary_beside(path)
    with contextlib.suppress(FileNotFoundError):
        path.rename(aside)
        remove_tree(aside)


def leftover_products(files: Files, older_than: float) -> list[Files]:
    """Return temporary folders that interrupted writers of products have left, if they are older than some seconds."""
    if files.local is None:  # no temporary folders there: a product without its seal is damaged
        return []
    limit = time.time() - older_than
    found = [p for p in sorted(files.local.glob(f".*.zarr.*{TEMPORARY}")) if p.lstat().st_mtime < limit]
    return [files.below(p.name) for p in found]


def products_in(files: Files) -> list[Files]:
    """Return all products (stored results of analyses) in a folder, damaged ones included."""
    files.refuse_links("")
    try:
        names = files.names()
    except (FileNotFoundError, NotADirectoryError):
        return []
    return [files.below(name) for name in names if name.endswith(".zarr") and not name.startswith(".")]


def blocks_beside(place: Files) -> Files:
    """Return the folder with blocks of a product while it is not finished."""
    return open_files(place.place.removesuffix(".zarr") + BLOCKS)


def blocks_in(files: Files) -> list[Files]:
    """Return the folders with blocks of unfinished products in a folder."""
    with contextlib.suppress(FileNotFoundError, NotADirectoryError):
        return [files.below(name) for name in files.names() if name.endswith(BLOCKS)]
    return []


def _own(attrs: Mapping[Any, Any]) -> dict[str, Any]:
    return {str(k): v for k, v in attrs.items() if k != SEAL}


def _put_in_place(temporary: Path, path: Path, attrs: Mapping[str, Any]) -> None:
    """Rename a finished product to its final path; first remove a damaged or different one there."""
    for _ in range(_MOST_TRIES):
        try:
            temporary.rename(path)
            return
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                raise
        with contextlib.suppress(FileNotFoundError, DamagedError):
            if _own(read_product_attrs(path)) == attrs:
                return
        remove_product(path)
    temporary.rename(path)


def _contents(ds: xr.Dataset) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Return the files of a product by key, with attributes and digest; and the attributes without it."""
    import zarr
    from zarr.storage import MemoryStore

    from pipeline.store.arrays import create_array

    data: dict[str, Any] = {}
    store = MemoryStore(data)
    group = zarr.create_group(store, zarr_format=3)
    for name in sorted(map(str, ds.variables)):
        values, attrs = coded(name, ds.variables[name])
        fill = np.nan if values.dtype.kind == "f" else 0
        dims = tuple(map(str, ds.variables[name].dims))
        chunks = _product_chunks(values)
        array = create_array(group, name, dims, values.shape, chunks, str(values.dtype), fill, attrs)
        if values.size:
            array[...] = values
    attrs = plain(ds.attrs)
    others = sorted(str(name) for name in ds.coords if name not in ds.dims)
    stored = {**attrs, "coordinates": " ".join(others)} if others else attrs
    digests = [(key, _sha256(value.to_bytes())) for key, value in data.items() if key != _GROUP]
    group.update_attributes({**stored, SEAL: _seal(stored, digests)})
    with warnings.catch_warnings():
        # readers over a network then ask once for the metadata of all arrays; see `pipeline.store.empty_cube`
        warnings.filterwarnings("ignore", message="Consolidated metadata")
        zarr.consolidate_metadata(store)
    return {key: value.to_bytes() for key, value in data.items()}, stored


def _seal(attrs: Mapping[str, Any], digests: Digests) -> str:
    """Return one digest of a product, computed from its attributes and the digests of its files."""
    digest = hashlib.sha256(json.dumps(_own(attrs), sort_keys=True).encode())
    for key, sha256 in sorted(digests, key=lambda entry: entry[0].split("/")):
        digest.update(f"\n{key} {sha256}".encode())
    return digest.hexdigest()


def _digests(files: Files) -> Digests:
    return _digests_of(files.read_each(key for key in files.everything() if key != _GROUP))


def _digests_of(contents: Iterable[tuple[str, bytes | FileNotFoundError]]) -> Digests:
    return [(key, _sha256(c)) for key, c in contents if key != _GROUP and isinstance(c, bytes)]


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _product_chunks(values: np.ndarray) -> tuple[int, ...]:
    """Return the chunk shape of an array: the whole array, or pieces of some megabytes along its first dimensions."""
    chunks = [max(n, 1) for n in values.shape]
    for i, n in enumerate(chunks):
        rest = values.itemsize * int(np.prod(chunks[i + 1 :]))
        chunks[i] = min(n, max(1, _PRODUCT_CHUNK_BYTES // rest))
        if chunks[i] > 1:
            break
    return tuple(chunks)


def coded(name: str, variable: xr.Variable) -> tuple[np.ndarray, dict[str, Any]]:
    """Return the values and attributes of a variable as they are stored: text labels become integer codes."""
    values = np.asarray(variable.values)
    attrs: dict[str, Any] = plain(variable.attrs)
    if values.dtype.kind not in "UO":
        return values, attrs
    if not all(isinstance(word, str) for word in values.flat):
        raise TypeError(f"{name}: objects other than texts cannot be stored.")
    words = {word: code for code, word in enumerate(dict.fromkeys(values.ravel().tolist()))}
    codes = np.array([words[word] for word in values.flat], np.int32).reshape(values.shape)
    return codes, {**attrs, _WORDS: list(words)}


def with_words(ds: xr.Dataset) -> dict[str, Any]:
    """Return the variables that are stored as codes, as text labels again."""
    found = {}
    for name, variable in ds.variables.items():
        if _WORDS in variable.attrs:
            attrs = {k: v for k, v in variable.attrs.items() if k != _WORDS}
            words = np.array(variable.attrs[_WORDS], dtype=str)
            found[str(name)] = (variable.dims, words[variable.values], attrs)
    return found


def plain(value: Any) -> Any:
    """Return an attribute as JSON values."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value


# ---- blocks of an unfinished product: a file each, so that a block costs one write -----------------

_ABOUT = "about.json"


def write_block(files: Files, key: str, ds: xr.Dataset) -> None:
    """Write a dataset to a file, whole or not at all."""
    arrays, variables = {}, {}
    for name in map(str, ds.variables):
        arrays[name], attrs = coded(name, ds.variables[name])
        variables[name] = [list(map(str, ds.variables[name].dims)), attrs]
    about = {"attrs": plain(ds.attrs), "coords": list(map(str, ds.coords)), "variables": variables}
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr(_ABOUT, json.dumps(about))
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, values, allow_pickle=False)
    files.write(key, content.getvalue())


def read_block(files: Files, key: str) -> xr.Dataset:
    """Read a dataset that `write_block` has written.

    Raise `FileNotFoundError` if there is none, and `DamagedError` if its content has changed.
    """
    import xarray as xr

    try:
        with zipfile.ZipFile(io.BytesIO(files.read(key))) as archive:
            about: dict[str, Any] = json.loads(archive.read(_ABOUT))
            variables = {
                name: (
                    dims,
                    np.lib.format.read_array(io.BytesIO(archive.read(f"{name}.npy")), allow_pickle=False),
                    attrs,
                )
                for name, (dims, attrs) in about["variables"].items()
            }
        ds = xr.Dataset({name: xr.Variable(*parts) for name, parts in variables.items()}, attrs=about["attrs"])
        ds = ds.set_coords(about["coords"])
    except (zipfile.BadZipFile, ValueError, KeyError, TypeError) as error:
        raise DamagedError(f"{files.name}/{key}: {error}") from None
    return ds.assign(with_words(ds))
