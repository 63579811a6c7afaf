"""The run directory: the only module that knows zarr.

::

    run.json      what is run: identity, digest, specification, versions; written once, last of the set-up
    cube.zarr/    the cells; crc32c ends every codec chain
    commits/      one JSON per finished task: the only proof that its cells are data
    timings.jsonl what took how long; no part of the result
    derived/      analysis products, each a sealed zarr group; see `pipeline.products.derived`
    figures/  lock

A task writes whole chunks, syncs the files and their folders, then writes its marker under a
temporary name, syncs, renames and syncs the folder. Whatever has no valid marker reads as pending and
is swept when the run goes on. Nothing that depends on time, workers or order enters ``cube.zarr`` and
``commits``: an interrupted run ends with the same bytes as an uninterrupted one.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import shutil
import time
import uuid
import warnings
from collections.abc import AsyncGenerator, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numcodecs.blosc
import numpy as np
import zarr
from zarr.abc.store import ByteRequest, Store
from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import LocalStore, WrapperStore

from pipeline.layout.cells import Coordinate, coordinates
from pipeline.layout.identity import canonical, differences, digest_of
from pipeline.layout.plan import Plan
from pipeline.spec.parsing import Spec

if TYPE_CHECKING:
    import xarray as xr

# With several threads blosc appends blocks in the order in which they finish: same data, other bytes.
numcodecs.blosc.use_threads = False

RUN_FILE, CUBE, COMMITS, LOCK, TIMINGS = "run.json", "cube.zarr", "commits", "lock", "timings.jsonl"
DERIVED = "derived"
OWN_NAMES = frozenset({RUN_FILE, CUBE, COMMITS, LOCK, TIMINGS, DERIVED, "figures"})
_TEMPORARY = ".tmp"


class StoreError(Exception):
    """The run directory cannot be used as asked; the message says why and what to do."""


class RefusedError(StoreError):
    """The directory holds another run, or is no run directory."""


class DamagedError(StoreError):
    """Committed data are not what was written."""


class LockedError(StoreError):
    """Another process is writing to the run directory."""


@dataclass(frozen=True)
class RunInfo:
    """What ``run.json`` holds.

    Attributes
    ----------
    directory : Path
    digest : str
        Of `identity`.
    identity : dict
        What decides the numbers and the layout.
    title : str
    spec : dict
        Plain data for `parse_spec`.
    spec_text : str
        The TOML file as it was.
    versions : dict
    skeleton : dict
        Size and sha256 of the files written by the set-up.
    """

    directory: Path
    digest: str
    identity: dict[str, Any]
    title: str
    spec: dict[str, Any]
    spec_text: str
    versions: dict[str, str]
    skeleton: dict[str, dict[str, Any]]


# ---- files -------------------------------------------------------------------------------------


def _sync_file(path: Path) -> None:
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _sync_folder(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _sync(files: Iterable[Path], top: Path) -> None:
    """Sync files, then every folder from theirs up to `top`."""
    folders: set[Path] = set()
    for file in files:
        _sync_file(file)
        folders.update(p for p in file.parents if p == top or top in p.parents)
    for folder in sorted(folders, key=lambda p: -len(p.parts)):
        _sync_folder(folder)


def _write_atomically(path: Path, text: str) -> None:
    """Write a small file so that after a crash it is there whole or not at all."""
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}{_TEMPORARY}")
    with temporary.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
    _sync_folder(path.parent)


def _object_entry(path: Path) -> dict[str, Any]:
    data = path.read_bytes()
    return {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def _files_below(folder: Path) -> Iterator[Path]:
    return (Path(base) / name for base, _, names in os.walk(folder) for name in names)


# ---- set-up ------------------------------------------------------------------------------------


def create(directory: Path, spec: Spec, plan: Plan, identity: dict[str, Any], spec_text: str) -> RunInfo:
    """Make a run directory; ``run.json`` comes last, so that without it nothing has begun."""
    directory.mkdir(parents=True, exist_ok=True)
    cube = directory / CUBE
    if cube.exists():
        shutil.rmtree(cube)
    digest = digest_of(identity)
    _write_skeleton(cube, spec, plan, {"title": spec.title, "spec": spec_text, "digest": digest})
    (directory / COMMITS).mkdir(exist_ok=True)
    files = list(_files_below(cube))
    _sync(files, directory)
    content = {
        "digest": digest,
        "identity": identity,
        "title": spec.title,
        "spec": spec.as_dict(),
        "spec_text": spec_text,
        "versions": _versions(),
        "skeleton": {f.relative_to(cube).as_posix(): _object_entry(f) for f in files},
    }
    _write_atomically(directory / RUN_FILE, canonical(content))
    _sync_folder(directory.parent)
    return read_run(directory)


def _versions() -> dict[str, str]:
    import platform
    from importlib import metadata

    found = {"python": platform.python_version(), "machine": platform.machine()}
    for name in ("magpend", "numpy", "numba", "zarr", "numcodecs"):
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def _write_skeleton(cube: Path, spec: Spec, plan: Plan, attrs: Mapping[str, Any]) -> None:
    """Write the metadata of all variables, and the coordinates."""
    kind = {
        "kind": plan.kind,
        "model": spec.model_name,
        "state": list(spec.model.state_names),
        "Conventions": "CF-1.11",
    }
    group = zarr.create_group(LocalStore(cube), zarr_format=3, attributes={**kind, **attrs})
    for variable in plan.variables:
        _create_array(
            group, variable.name, (*plan.dims, *variable.own_dims),
            (*plan.shape, *plan.chunks(variable)[len(plan.shape) :]),
            plan.chunks(variable), variable.dtype, variable.fill, variable.attributes(),
        )  # fmt: skip
    for coordinate in coordinates(spec):
        _write_coordinate(group, coordinate)


def _create_array(
    group: zarr.Group, name: str, dims: tuple[str, ...], shape: tuple[int, ...], chunks: tuple[int, ...],
    dtype: str, fill: float | int, attrs: Mapping[str, Any],
) -> Any:  # fmt: skip
    return group.create_array(
        name,
        shape=shape,
        chunks=chunks,
        dtype=dtype,
        fill_value=fill,
        serializer=BytesCodec(endian="little") if np.dtype(dtype).itemsize > 1 else BytesCodec(endian=None),
        compressors=[BloscCodec(cname="lz4", clevel=5, shuffle="shuffle"), Crc32cCodec()],
        chunk_key_encoding={"name": "default", "separator": "."},
        dimension_names=dims,
        attributes=dict(attrs),
        config={"write_empty_chunks": True},
    )


def _write_coordinate(group: zarr.Group, coordinate: Coordinate) -> None:
    values = np.asarray(coordinate.values)
    fill = np.nan if values.dtype.kind == "f" else 0
    chunks = tuple(max(n, 1) for n in values.shape)
    array = _create_array(
        group,
        coordinate.name,
        coordinate.dims,
        values.shape,
        chunks,
        str(values.dtype),
        fill,
        coordinate.attrs,
    )
    array[...] = values


def is_run(directory: Path) -> bool:
    """Whether a run has been set up there."""
    return (directory / RUN_FILE).is_file()


def read_run(directory: Path) -> RunInfo:
    """Read ``run.json``; raises `RefusedError` if there is none or it is damaged."""
    path = directory / RUN_FILE
    try:
        data = json.loads(path.read_text("utf-8"))
        info = RunInfo(directory=directory, **data)
    except FileNotFoundError:
        raise RefusedError(f"{directory}: no run directory (it has no {RUN_FILE}).") from None
    except (ValueError, TypeError) as error:
        raise RefusedError(f"{path}: damaged ({error}); remove the directory and run again.") from None
    if digest_of(info.identity) != info.digest:
        raise RefusedError(f"{path}: damaged (its digest does not fit); remove the directory and run again.")
    return info


def check(directory: Path, identity: dict[str, Any]) -> RunInfo | None:
    """Say whether this run can be done in this directory.

    Returns
    -------
    RunInfo or None
        What is there already; None if the run can be set up.

    Raises
    ------
    RefusedError
        If another run is there (with the difference), or something else.
    """
    if is_run(directory):
        info = read_run(directory)
        lines = differences(info.identity, identity)
        if lines:
            raise RefusedError(
                f"{directory}: holds another run. Give another --out, or remove it. What differs:\n  "
                + "\n  ".join(lines)
            )
        return info
    if directory.exists() and not directory.is_dir():
        raise RefusedError(f"{directory}: is a file; give another --out.")
    foreign = sorted(p.name for p in directory.iterdir() if not _is_own(p)) if directory.exists() else []
    if foreign or any(directory.glob(f"{COMMITS}/*.json")):
        names = ", ".join(foreign[:5]) or f"{COMMITS} without {RUN_FILE}"
        raise RefusedError(f"{directory}: is not empty and no run directory ({names}); give another --out.")
    return None


def _is_own(path: Path) -> bool:
    return path.name in OWN_NAMES or (path.name.startswith(f".{RUN_FILE}") and path.name.endswith(_TEMPORARY))


@contextlib.contextmanager
def writer_lock(directory: Path) -> Iterator[None]:
    """Hold the directory's lock: a courtesy between people, the commit protocol does not rest on it.

    Raises
    ------
    LockedError
        If another process holds it.
    """
    from filelock import FileLock, Timeout

    directory.mkdir(parents=True, exist_ok=True)
    lock = FileLock(directory / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise LockedError(
            f"{directory}: another magpend run is writing here. Wait for it or stop it, then run again."
        ) from None
    except (NotImplementedError, OSError) as error:
        warnings.warn(f"{directory}: no file lock here ({error}); start one run at a time.", stacklevel=3)
        yield
        return
    try:
        yield
    finally:
        lock.release()


# ---- tasks -------------------------------------------------------------------------------------


def write_task(
    info: RunInfo, plan: Plan, index: int, values: Mapping[str, np.ndarray], counts: Mapping[str, int]
) -> None:
    """Write a task's cells and commit them.

    Parameters
    ----------
    info
        The run.
    plan
        Its plan.
    index
        The task.
    values
        Every variable, in the shape of the task's block followed by its own dims.
    counts
        Cells by status name, for `status`.
    """
    cube = info.directory / CUBE
    objects = [key for v in plan.variables for key in _write_block(cube, plan, index, v.name, values[v.name])]
    _sync((cube / key for key in objects), cube)
    marker = {
        "digest": info.digest,
        "task": index,
        "status": dict(counts),
        "objects": {key: _object_entry(cube / key) for key in objects},
    }
    _write_atomically(marker_path(info.directory, index), canonical(marker))


def _write_block(cube: Path, plan: Plan, index: int, name: str, values: np.ndarray) -> list[str]:
    """Write one variable's chunks of a task and return their keys."""
    array = zarr.open_array(LocalStore(cube), path=name, mode="r+")
    # The setting is not stored: without it a block equal to the fill value would leave no file.
    array = array.with_config({"write_empty_chunks": True})
    block = plan.task(index)
    own = array.shape[len(block) :]
    region = (*block, *(slice(0, n) for n in own))
    expected = tuple(s.stop - s.start for s in region)
    if values.shape != expected or values.dtype != array.dtype:
        raise ValueError(
            f"{name}: {values.dtype} {values.shape} where the store has {array.dtype} {expected}."
        )
    keys = _chunk_keys(name, region, array.chunks, array.shape)
    array[region] = values
    return keys


def _chunk_keys(
    name: str, region: tuple[slice, ...], chunks: tuple[int, ...], shape: tuple[int, ...]
) -> list[str]:
    """Keys of the chunks in a region; a region that cuts a chunk would lose a neighbour's cells."""
    for s, c, n in zip(region, chunks, shape, strict=True):
        if s.start % c or (s.stop % c and s.stop != n):
            raise ValueError(f"{name}: region {region} cuts chunks of {chunks}.")
    places = [range(s.start // c, -(-s.stop // c)) for s, c in zip(region, chunks, strict=True)]
    if not places:
        return [f"{name}/c"]
    grid = np.stack(np.meshgrid(*places, indexing="ij"), axis=-1).reshape(-1, len(places))
    return [f"{name}/c." + ".".join(map(str, place)) for place in grid]


def marker_path(directory: Path, index: int) -> Path:
    """Where a task's marker lies."""
    return directory / COMMITS / f"{index:06d}.json"


@dataclass(frozen=True)
class Commit:
    """A valid marker."""

    task: int
    status: dict[str, int]
    objects: dict[str, dict[str, Any]]


def read_commits(info: RunInfo, plan: Plan) -> dict[int, Commit]:
    """Return the valid markers by task: right digest, and all objects there in their size."""
    found = {}
    sizes = _sizes(info.directory / CUBE)
    for path in sorted((info.directory / COMMITS).glob("*.json")):
        commit = _read_marker(path, info, plan)
        if commit and all(sizes.get(key) == entry["size"] for key, entry in commit.objects.items()):
            found[commit.task] = commit
    return found


def _sizes(cube: Path) -> dict[str, int]:
    """Size of every file of the cube by key."""
    return {
        f"{a.name}/{f.name}": f.stat().st_size for a in os.scandir(cube) if a.is_dir() for f in os.scandir(a)
    }


def _read_marker(path: Path, info: RunInfo, plan: Plan) -> Commit | None:
    """Return a marker if it is whole, of this run and of this task."""
    try:
        data = json.loads(path.read_bytes())
        commit = Commit(int(data["task"]), dict(data["status"]), dict(data["objects"]))
        complete = all(
            isinstance(e["size"], int) and isinstance(e["sha256"], str) for e in commit.objects.values()
        )
        right = data["digest"] == info.digest and 0 <= commit.task < plan.n_tasks
        named = path.name == marker_path(info.directory, commit.task).name
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return commit if complete and right and named and commit.objects else None


def sweep(info: RunInfo, commits: Mapping[int, Commit]) -> int:
    """Remove leftovers: chunk files and markers that no valid marker vouches for. Returns how many.

    Only for the holder of the lock. Nothing outside ``cube.zarr`` and ``commits`` is touched.
    """
    cube = info.directory / CUBE
    keep = {*info.skeleton, *(key for commit in commits.values() for key in commit.objects)}
    markers = {marker_path(info.directory, index) for index in commits}
    leftovers = [f for f in _files_below(cube) if f.relative_to(cube).as_posix() not in keep]
    leftovers += [f for f in (info.directory / COMMITS).iterdir() if f not in markers]
    for file in leftovers:
        file.unlink()
    return len(leftovers)


@dataclass(frozen=True)
class Verification:
    """What `verify` found.

    Attributes
    ----------
    n_tasks, n_committed : int
    damaged : dict
        Problem by task.
    skeleton : list of str
        Problems of metadata and coordinates, which a run cannot mend.
    leftovers : list of str
        Files that nothing vouches for; harmless, swept by the next run.
    """

    n_tasks: int
    n_committed: int
    damaged: dict[int, str]
    skeleton: list[str]
    leftovers: list[str]

    @property
    def sound(self) -> bool:
        """Whether all that is committed is intact."""
        return not self.damaged and not self.skeleton


def verify(info: RunInfo, plan: Plan) -> Verification:
    """Read every committed file and compare its sha256 with its marker."""
    cube = info.directory / CUBE
    damaged: dict[int, str] = {}
    vouched = set(info.skeleton)
    paths = sorted((info.directory / COMMITS).glob("*.json"))
    for path in paths:
        commit = _read_marker(path, info, plan)
        if commit is None:
            damaged[int(path.stem) if path.stem.isdigit() else -1] = (
                f"{path.name}: no valid marker of this run"
            )
            continue
        vouched.update(commit.objects)
        problems = _object_problems(cube, commit.objects)
        if problems:
            damaged[commit.task] = "; ".join(problems)
    leftovers = [f.relative_to(cube).as_posix() for f in _files_below(cube)]
    return Verification(
        n_tasks=plan.n_tasks,
        n_committed=len(paths) - len(damaged),
        damaged=damaged,
        skeleton=_object_problems(cube, info.skeleton),
        leftovers=sorted(key for key in leftovers if key not in vouched),
    )


def _object_problems(cube: Path, objects: Mapping[str, Mapping[str, Any]]) -> list[str]:
    problems = []
    for key, entry in objects.items():
        path = cube / key
        if not path.is_file():
            problems.append(f"{key}: missing")
        elif _object_entry(path) != dict(entry):
            problems.append(f"{key}: its content has changed")
    return problems


def withdraw(info: RunInfo, tasks: Iterable[int]) -> None:
    """Remove the markers of tasks, so that the next run computes them again."""
    for index in tasks:
        marker_path(info.directory, index).unlink(missing_ok=True)
    _sync_folder(info.directory / COMMITS)


def log_timing(directory: Path, entry: Mapping[str, Any]) -> None:
    """Append what a task took to ``timings.jsonl``; no part of the result, not synced."""
    with (directory / TIMINGS).open("a", encoding="utf-8") as file:
        file.write(json.dumps(entry, sort_keys=True) + "\n")


# ---- reading -----------------------------------------------------------------------------------


class CommittedStore(WrapperStore[Store]):
    """A read-only view of the cube in which a chunk without a valid marker does not exist.

    zarr then reads it as the fill value: pending.
    """

    def __init__(self, store: Store, visible: frozenset[str] = frozenset()) -> None:
        super().__init__(store)
        self._visible = visible

    def _with_store(self, store: Store) -> CommittedStore:
        return type(self)(store, self._visible)

    def _shows(self, key: str) -> bool:
        return key.endswith("zarr.json") or key in self._visible

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """As in zarr, without what is not committed."""
        return await self._store.get(key, prototype, byte_range) if self._shows(key) else None

    async def exists(self, key: str) -> bool:
        """As in zarr, without what is not committed."""
        return self._shows(key) and await self._store.exists(key)

    async def get_partial_values(
        self, prototype: BufferPrototype, key_ranges: Iterable[tuple[str, ByteRequest | None]]
    ) -> list[Buffer | None]:
        """As in zarr, without what is not committed."""
        return [await self.get(key, prototype, byte_range) for key, byte_range in key_ranges]

    async def _get_many(
        self, requests: Iterable[tuple[str, BufferPrototype, ByteRequest | None]]
    ) -> AsyncGenerator[tuple[str, Buffer | None], None]:
        for key, prototype, byte_range in requests:
            yield key, await self.get(key, prototype, byte_range)


def committed_view(info: RunInfo, plan: Plan, commits: Mapping[int, Commit] | None = None) -> CommittedStore:
    """Return the store to read from; it shows what `commits` vouch for, by default all that is there."""
    commits = read_commits(info, plan) if commits is None else commits
    visible = frozenset({*info.skeleton, *(key for commit in commits.values() for key in commit.objects)})
    return CommittedStore(LocalStore(info.directory / CUBE, read_only=True), visible)


# ---- derived products --------------------------------------------------------------------------

SEAL = "content_sha256"
"""Attribute of a product: digest of its other attributes and of all its files but the one that holds it."""

_WORDS = "words"
_PRODUCT_CHUNK_BYTES = 16_000_000


def cube_digest(info: RunInfo, commits: Mapping[int, Commit]) -> str:
    """Digest of what is committed of a run: its identity, and the sha256 of every committed object."""
    objects = {str(index): commits[index].objects for index in sorted(commits)}
    return digest_of({"run": info.digest, "commits": objects})


def write_product(path: Path, ds: xr.Dataset) -> None:
    """Write a dataset so that it is at `path` whole or not at all.

    Words are stored as codes (the attribute ``words`` lists them), since zarr format 3 has no strings
    of fixed length. If another process puts a sound product of the same attributes there first, that
    one stays.

    Raises
    ------
    OSError
        If the folder cannot be written to.
    """
    path.parent.mkdir(exist_ok=True)
    temporary = _temporary_beside(path)
    try:
        attrs = _write_group(temporary, ds)
        _sync(_files_below(temporary), temporary)
        _put_in_place(temporary, path, attrs)
        _sync_folder(path.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def open_product(path: Path) -> xr.Dataset:
    """Read a product into memory.

    Raises
    ------
    FileNotFoundError
        If there is none.
    DamagedError
        If it is not what was written.
    """
    import xarray as xr

    read_product_attrs(path)
    try:
        with xr.open_zarr(LocalStore(path, read_only=True), consolidated=False, chunks=None) as ds:
            loaded = ds.load().assign(_with_words(ds))
    except (ValueError, KeyError, OSError) as error:
        raise DamagedError(f"{path}: {error}") from None
    variables = {name: loaded.variables[name] for name in sorted(map(str, loaded.data_vars))}
    return xr.Dataset(variables, loaded.coords, _own(loaded.attrs))


def read_product_attrs(path: Path) -> dict[str, Any]:
    """Attributes of a product, once its seal has been found to fit.

    Raises
    ------
    FileNotFoundError
        If there is none.
    DamagedError
        If it is not what was written.
    """
    if not path.exists():
        raise FileNotFoundError(path)
    try:
        attrs: dict[str, Any] = json.loads((path / "zarr.json").read_text("utf-8"))["attributes"]
        if attrs[SEAL] == _seal(path, attrs):
            return attrs
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DamagedError(f"{path}: {error!r}") from None
    raise DamagedError(f"{path}: its content has changed")


def remove_product(path: Path) -> None:
    """Remove a product; one that is gone already is no error."""
    aside = _temporary_beside(path)
    with contextlib.suppress(FileNotFoundError):
        path.rename(aside)
    shutil.rmtree(aside, ignore_errors=True)


def leftover_products(folder: Path, older_than: float) -> list[Path]:
    """Temporary folders of products that nothing has changed for some seconds."""
    limit = time.time() - older_than
    return [p for p in sorted(folder.glob(f".*.zarr.*{_TEMPORARY}")) if p.stat().st_mtime < limit]


def _temporary_beside(path: Path) -> Path:
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}{_TEMPORARY}")


def _own(attrs: Mapping[Any, Any]) -> dict[str, Any]:
    return {str(k): v for k, v in attrs.items() if k != SEAL}


def _put_in_place(temporary: Path, path: Path, attrs: Mapping[str, Any]) -> None:
    """Rename a finished product; a damaged or another one at its place makes way."""
    while True:
        try:
            temporary.rename(path)
            return
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
        with contextlib.suppress(FileNotFoundError, DamagedError):
            if _own(read_product_attrs(path)) == attrs:
                return
        remove_product(path)


def _write_group(folder: Path, ds: xr.Dataset) -> dict[str, Any]:
    """Write all variables, then the attributes with the seal; returns the attributes without it."""
    group = zarr.create_group(LocalStore(folder), zarr_format=3)
    for name in sorted(map(str, ds.variables)):
        values, attrs = _coded(name, ds.variables[name])
        fill = np.nan if values.dtype.kind == "f" else 0
        dims = tuple(map(str, ds.variables[name].dims))
        chunks = _product_chunks(values)
        array = _create_array(group, name, dims, values.shape, chunks, str(values.dtype), fill, attrs)
        if values.size:
            array[...] = values
    attrs = _plain(ds.attrs)
    others = sorted(str(name) for name in ds.coords if name not in ds.dims)
    stored = {**attrs, "coordinates": " ".join(others)} if others else attrs
    group.update_attributes({**stored, SEAL: _seal(folder, stored)})
    return stored


def _seal(folder: Path, attrs: Mapping[str, Any]) -> str:
    """Digest of a product's attributes and files."""
    digest = hashlib.sha256(json.dumps(_own(attrs), sort_keys=True).encode())
    for file in sorted(f for f in _files_below(folder) if f != folder / "zarr.json"):
        digest.update(f"\n{file.relative_to(folder).as_posix()} {_object_entry(file)['sha256']}".encode())
    return digest.hexdigest()


def _product_chunks(values: np.ndarray) -> tuple[int, ...]:
    """Whole arrays, or parts of some megabytes cut along the first dims."""
    chunks = [max(n, 1) for n in values.shape]
    for i, n in enumerate(chunks):
        rest = values.itemsize * int(np.prod(chunks[i + 1 :]))
        chunks[i] = min(n, max(1, _PRODUCT_CHUNK_BYTES // rest))
        if chunks[i] > 1:
            break
    return tuple(chunks)


def _coded(name: str, variable: xr.Variable) -> tuple[np.ndarray, dict[str, Any]]:
    """Values and attributes as they are stored: words as codes."""
    values = np.asarray(variable.values)
    attrs: dict[str, Any] = _plain(variable.attrs)
    if values.dtype.kind not in "UO":
        return values, attrs
    if not all(isinstance(word, str) for word in values.flat):
        raise TypeError(f"{name}: objects other than words cannot be stored.")
    words = {word: code for code, word in enumerate(dict.fromkeys(values.ravel().tolist()))}
    codes = np.array([words[word] for word in values.flat], np.int32).reshape(values.shape)
    return codes, {**attrs, _WORDS: list(words)}


def _with_words(ds: xr.Dataset) -> dict[str, Any]:
    """Variables that were words, as words again."""
    found = {}
    for name, variable in ds.variables.items():
        if _WORDS in variable.attrs:
            attrs = {k: v for k, v in variable.attrs.items() if k != _WORDS}
            words = np.array(variable.attrs[_WORDS], dtype=str)
            found[str(name)] = (variable.dims, words[variable.values], attrs)
    return found


def _plain(value: Any) -> Any:
    """Attributes as JSON has them."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
