"""Read and write ``run.json``: the specification, the run's digest, and sha256 digests of the result cube's metadata
and coordinates.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pipeline.layout.identity import digest_of, foreign_keys
from pipeline.layout.plan import Plan, make_plan
from pipeline.layout.schema import FORMAT
from pipeline.specification.models import KEPT
from pipeline.specification.problems import SpecError, shown
from pipeline.specification.recorded_drive import is_whole
from pipeline.specification.spec import Spec
from pipeline.store.errors import DamagedError, RefusedError
from pipeline.store.files import RUN_FILE, Files
from pipeline.store.objects import open_files
from pipeline.store.provenance import provenance, versions
from pipeline.store.stored_json import CHECKSUM, StoredRun, fits, has_seal, parsed, seal


@dataclass(frozen=True)
class RunInfo:
    """A run directory: its files, the content of its ``run.json``, and the plan that follows from it."""

    files: Files  # files of the run directory
    digest: str  # digest of `identity`
    identity: dict[str, Any]  # everything that decides the numbers and the layout
    title: str  # title from the specification
    spec: dict[str, Any]  # specification as plain data for `Spec.parse`
    spec_text: str  # text of the TOML file
    versions: dict[str, str]  # versions of the packages that made the run
    provenance: dict[str, str]  # see `pipeline.store.provenance`
    skeleton: dict[str, dict[str, Any]]  # size and sha256 of the files written by the set-up

    @property
    def name(self) -> str:
        """Path or URL of the run directory."""
        return self.files.name

    def parsed_spec(self) -> Spec:
        """Parse the specification; raise `DamagedError` if this version cannot read it."""
        try:
            return Spec.parse(self.spec, KEPT)
        except SpecError as error:
            made = self.versions.get("magpend", "not named")
            raise DamagedError(
                f"{self.files.below(RUN_FILE).name}: its specification cannot be read: {error.problems[0]} It was made "
                f"by magpend {made}; read it with that version, or run its specification into another directory."
            ) from None

    @cached_property
    def plan(self) -> Plan:
        """Plan of the run; raises `DamagedError` if this version cannot read its specification."""
        return make_plan(self.parsed_spec(), self.spec_text)

    @property
    def directory(self) -> Path:
        """Path of the run directory; raises `RefusedError` for a run that is not in a folder of this machine."""
        if self.files.local is None:
            raise RefusedError(f"{self.name}: is no folder of this machine, which this needs.")
        return self.files.local


def is_run(files: Files) -> bool:
    """Return whether a folder or an object store prefix holds a run, that is, a ``run.json``."""
    return files.is_there(RUN_FILE)


def read_run(place: str | Path | Files) -> RunInfo:
    """Read and check ``run.json``.

    Raise `RefusedError` if it does not exist or has another format, and `DamagedError` if it has changed since it was
    written.
    """
    files = open_files(place)
    directory, path = files.name, files.below(RUN_FILE).name
    try:
        content = files.read(RUN_FILE)
    except FileNotFoundError:
        raise RefusedError(f"{directory}: no run directory (it has no {RUN_FILE}).") from None
    try:
        data = json.loads(content)
        _refuse_format(path, data, content)
        whole = fits(content) and data.pop(CHECKSUM) is not None
        info = RunInfo(files=files, **parsed(StoredRun, data)) if whole else None
        whole = info is not None and digest_of(info.identity) == info.digest and is_whole(info.spec.get("drive"))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise DamagedError(f"{path}: damaged ({error}); {remade(directory)}") from None
    if info is None or not whole:
        raise DamagedError(f"{path}: damaged (its checksum does not fit); {remade(directory)}")
    if keys := foreign_keys(info.identity, info.spec):
        named = ", ".join(keys[:3])
        raise DamagedError(f"{path}: damaged (its identity is of another specification: {named}); {remade(directory)}")
    return info


def _refuse_format(path: str, data: Mapping[str, Any], content: bytes) -> None:
    """Raise `RefusedError` for another format number in ``run.json``, unless the number may be damaged."""
    found = data["identity"]["format"]
    if isinstance(found, (int, float)) and found != FORMAT and (fits(content) or not has_seal(content)):
        raise RefusedError(
            f"{path}: format {shown(found)}, and this magpend reads {FORMAT}; read it with the version that "
            f"made it ({data['versions'].get('magpend', 'not named')}), or run its specification "
            "into another directory."
        )


def remade(directory: str) -> str:
    """Return the clause that says how a damaged ``run.json`` of the run in a directory is made again."""
    return (
        f"give the command that made it again (magpend run SPEC --out {directory}): "
        "it is rebuilt, and committed results stay."
    )


def write_run(
    files: Files, plan: Plan, identity: Mapping[str, Any], skeleton: Mapping[str, Mapping[str, Any]]
) -> RunInfo:
    """Write ``run.json`` and return its content."""
    content = {
        "digest": digest_of(identity),
        "identity": identity,
        "title": plan.spec.title,
        "spec": plan.spec.as_dict(),
        "spec_text": plan.text,
        "versions": versions(),
        "provenance": provenance(),
        "skeleton": skeleton,
    }
    # keys are not sorted: the axes stand in the order of the cube's dims
    text = json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False)
    files.write(RUN_FILE, seal(text).encode())
    return read_run(files)
