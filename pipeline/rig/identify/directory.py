"""Write and read the directory of an identification, which can be stopped and continued.

    identification.json   specification, mappings, digest, versions, host, time: written once
    outcomes/             a file for each local fit and each profile, written whole
    result.json           estimates with their errors and warnings; written last
    residuals.nc  preset.toml  figures/  lock

An identification that was stopped continues with the kept outcomes, and ends with the same bytes.
"""

from __future__ import annotations

import hashlib
import io
import json
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar
from zipfile import BadZipFile

import numpy as np
import xarray as xr

from magpend_core.models import load_model
from magpend_core.models.imported import is_object_path
from magpend_core.versions import ENGINE
from pipeline.layout.identity import canonical, differences, digest_of, numbered
from pipeline.layout.writing import sync_folder, write_atomically
from pipeline.rig.identify.measured_orbits import MeasuredTable, stored_table
from pipeline.rig.identify.specification import IdentificationSpec
from pipeline.rig.recordings import load_mapping
from pipeline.specification.models import is_model_file
from pipeline.store.errors import DamagedError, RefusedError
from pipeline.store.files import HOLDER, LOCK, RUN_FILE, entry_of, is_temporary, local_path, problems_of
from pipeline.store.local import is_there, refuse_place, unreadable
from pipeline.store.objects import open_files
from pipeline.store.provenance import provenance, versions

T = TypeVar("T")

FIT_FORMAT = 1
IDENTIFICATION, RESULT, RESIDUALS, PRESET, OUTCOMES = (
    "identification.json",
    "result.json",
    "residuals.nc",
    "preset.toml",
    "outcomes",
)
ORBITS = "orbits-{}.nc"
"""Name of the file of the judged orbits of each table."""

POSTERIOR = "posterior.nc"

FIT = 1
"""Number of the results of identifications, see `magpend_core.versions`."""


@dataclass(frozen=True)
class Source:
    """Recording of an identification: its file name and sha256, with the text of its mapping file."""

    file: str
    sha256: str
    mapping: str


@dataclass(frozen=True)
class Info:
    """Content of ``identification.json``."""

    directory: Path
    digest: str  # digest of `identity`
    identity: dict[str, Any]  # everything that decides the numbers
    title: str
    spec_text: str
    files: list[str]  # names of the recordings
    mappings: list[str]
    versions: dict[str, str]
    provenance: dict[str, str]


def sources_of(spec: IdentificationSpec) -> list[Source]:
    """Read the bytes of each recording and the text of its mapping; raise `SpecError` if a file cannot be read."""
    from pipeline.specification.problems import SpecError

    found, problems = [], []
    for i, table in enumerate(spec.recordings):
        try:
            data = spec.path(table.file).read_bytes()
            text = _kept(spec.path(table.mapping))
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            problems.append(f"recordings[{i}]: cannot be read ({error}).")
            continue
        found.append(Source(Path(table.file).name, hashlib.sha256(data).hexdigest(), text))
    if problems:
        raise SpecError(problems)
    return found


def _kept(path: Path) -> str:
    """Return the text of a mapping file, with the model written into it if the model comes from another file."""
    text = path.read_text("utf-8")
    model = tomllib.loads(text).get("model")
    is_whole = isinstance(model, str) and not is_model_file(model) and not is_object_path(model)
    return text if is_whole else load_mapping(path).toml()


def identity_of(
    spec: IdentificationSpec, sources: Sequence[Source], orbits: Sequence[MeasuredTable] = ()
) -> dict[str, Any]:
    """Return all inputs that decide the numbers: specification, recordings, model and versions."""
    tables = spec.as_dict()
    for table, source in zip(tables["recordings"], sources, strict=True):
        del table["file"], table["mapping"]
        table["sha256"] = source.sha256
        table["mapping_text"] = source.mapping
    for table, measured in zip(tables["orbits"], orbits, strict=True):
        table.pop("file", None)
        table["data"] = measured.as_dict()
    return {
        "format": FIT_FORMAT,
        "spec": tables,
        "model_digest": spec.model.digest,
        "versions": {"engine": ENGINE, "fit": FIT},
    }


def is_identification(directory: str | Path) -> bool:
    """Return whether a directory holds an identification."""
    return is_there(local_path(directory) / IDENTIFICATION)


def read_info(directory: str | Path) -> Info:
    """Read ``identification.json``.

    Raise `RefusedError` if it does not exist or has another format, and `DamagedError` if it has changed since it was
    written.
    """
    directory = local_path(directory)
    path = directory / IDENTIFICATION
    if not is_identification(directory):
        run = " It is a run; see magpend status." if is_there(directory / RUN_FILE) else ""
        raise RefusedError(f"{directory}: no identification (it has no {IDENTIFICATION}).{run}")
    with unreadable(path):
        content = path.read_bytes()
    try:
        data = json.loads(content)
        found = data["identity"]["format"]
        if found != FIT_FORMAT:
            raise RefusedError(
                f"{path}: format {found}, and this magpend reads {FIT_FORMAT}; identify again into another directory."
            )
        info = Info(directory=directory, **data)
        fits = digest_of(info.identity) == info.digest
    except (ValueError, TypeError, KeyError) as error:
        raise DamagedError(f"{path}: damaged ({error}); remove {directory} and identify again.") from None
    if not fits:
        raise DamagedError(f"{path}: damaged (its digest does not fit); remove {directory} and identify again.")
    return info


def check(directory: Path, identity: Mapping[str, Any]) -> Info | None:
    """Return the identification in a directory if it has the given identity, or None if the directory is free.

    Raise `RefusedError` if it holds other files or another identification; the message lists the differences.
    """
    if directory.exists() and not directory.is_dir():
        raise RefusedError(f"{directory}: is a file; give another --out.")
    refuse_place(directory, "--out")
    if not directory.exists():
        return None
    if not is_identification(directory):
        with unreadable(directory):
            locks = (LOCK, HOLDER)
            found = [p.name for p in directory.iterdir()]
            names = sorted(name for name in found if name not in locks and not is_temporary(name))
        if names:
            raise RefusedError(
                f"{directory}: is not empty and holds no identification ({', '.join(names[:5])}); give another --out."
            )
        return None
    info = read_info(directory)
    lines = differences(numbered(info.identity), identity)
    if lines:
        raise RefusedError(
            f"{directory}: holds another identification. Give another --out, or remove it. Differences:\n  "
            + "\n  ".join(_short(line) for line in lines)
        )
    return info


def _short(line: str) -> str:
    flat = " ".join(line.split())
    return flat if len(flat) <= 400 else f"{flat[:197]} ... {flat[-197:]}"


def establish(
    directory: Path,
    spec: IdentificationSpec,
    sources: Sequence[Source],
    spec_text: str,
    orbits: Sequence[MeasuredTable] = (),
) -> Info:
    """Create the directory with its ``identification.json``, unless they exist; return the content of this file."""
    identity = identity_of(spec, sources, orbits)
    if check(directory, identity) is None:
        directory.mkdir(parents=True, exist_ok=True)
        content = {
            "digest": digest_of(identity),
            "identity": identity,
            "title": spec.title,
            "spec_text": spec_text,
            "files": [s.file for s in sources],
            "mappings": [s.mapping for s in sources],
            "versions": versions(),
            "provenance": provenance(),
        }
        write_atomically(directory / IDENTIFICATION, canonical(content))
        sync_folder(directory.parent)
    (directory / OUTCOMES).mkdir(exist_ok=True)
    return read_info(directory)


class Outcomes:
    """Stored outcomes of local fits and profiles, one file per outcome. A continued identification reads them again."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.recalled = 0

    def recall(self, name: str, unpack: Callable[[Mapping[str, np.ndarray]], T]) -> T | None:
        """Return a stored outcome, or None if its file is missing or damaged."""
        path = self._folder / f"{name}.npz"
        if not is_there(path):
            return None
        try:
            with unreadable(path), np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as data:
                found = unpack({key: data[key] for key in data.files})
        except (ValueError, KeyError, EOFError, BadZipFile):
            return None
        self.recalled += 1
        return found

    def store(self, name: str, packed: Mapping[str, np.ndarray]) -> None:
        """Write an outcome to its file atomically."""
        buffer = io.BytesIO()
        np.savez(buffer, **packed)  # type: ignore[arg-type]
        write_atomically(self._folder / f"{name}.npz", buffer.getvalue())


def write_result(directory: Path, result: Mapping[str, Any], files: Sequence[str]) -> None:
    """Write ``result.json`` with the sha256 of the other files; it marks the identification as finished."""
    entries = {name: entry_of((directory / name).read_bytes()) for name in sorted(files)}
    write_atomically(directory / RESULT, canonical({**result, "files": entries}))


def read_result(directory: str | Path) -> dict[str, Any]:
    """Read ``result.json`` of a finished identification; raise `RefusedError` if it is not finished."""
    path = local_path(directory) / RESULT
    read_info(directory)
    if not is_there(path):
        raise RefusedError(f"{directory}: the identification is not finished; give its command again: it goes on.")
    try:
        with unreadable(path):
            found: dict[str, Any] = json.loads(path.read_bytes())
    except ValueError as error:
        raise DamagedError(f"{path}: damaged ({error}); remove it and identify again.") from None
    return found


def is_complete(directory: Path) -> bool:
    """Return whether ``result.json`` and all files that it lists exist unchanged."""
    if not is_there(directory / RESULT):
        return False
    try:
        result = read_result(directory)
    except DamagedError:
        return False
    return not problems_of(open_files(directory), result.get("files", {}))


def stored_tables(directory: str | Path) -> list[MeasuredTable]:
    """Return the measured orbits of a finished identification, one `MeasuredTable` per table ``[[orbits]]``."""
    info, result = read_info(directory), read_result(directory)
    model = load_model(result["model"])
    found = []
    for i, table in enumerate(info.identity["spec"]["orbits"]):
        with xr.open_dataset(Path(directory) / ORBITS.format(i), engine="scipy") as ds:
            # a dim of length 0 is read as an unlimited one
            measured = ds.load().drop_encoding()
        found.append(stored_table(table["data"], model, measured if "orbit" in measured.sizes else None))
    return found
