"""Write the files of an empty result cube (metadata and coordinates), and compare them with their digests."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from pipeline.layout.cells import coordinates, further_coordinates
from pipeline.layout.plan import Plan
from pipeline.store.declared import METADATA, consolidated_metadata, disagreements
from pipeline.store.errors import DamagedError
from pipeline.store.files import CUBE, Files, compared, entry_of
from pipeline.store.runfile import RunInfo

MOST_KEPT = 1_000_000
"""Largest size in bytes of a file of the set-up whose content an opened run keeps, so that it is read once."""


def lacking(info: RunInfo) -> list[str]:
    """Return the keys of files of variables and coordinates that ``run.json`` should name, and does not."""
    spec = info.plan.spec
    found = [f"{v.name}/{METADATA}" for v in info.plan.variables]
    for coordinate in (*coordinates(spec), further_coordinates(spec)[0]):
        found += [f"{coordinate.name}/{end}" for end in (METADATA, ".".join(["c", *["0"] * len(coordinate.dims)]))]
    return [key for key in found if key not in info.skeleton]


def skeleton_keys(plan: Plan) -> list[str]:
    """Return the keys of the metadata files of all variables and coordinates of the result cube."""
    found = (*coordinates(plan.spec), *further_coordinates(plan.spec))
    names = [v.name for v in plan.variables] + [c.name for c in found]
    return [f"{name}/{METADATA}" for name in names]


def entries_of(files: Mapping[str, bytes]) -> dict[str, dict[str, Any]]:
    """Return the size and sha256 of each file's content by key, for ``run.json``."""
    return {key: entry_of(content) for key, content in files.items()}


def write_skeleton(files: Files, contents: Mapping[str, bytes], keys: Iterable[str]) -> None:
    """Write some of the metadata and coordinate files of a result cube, each atomically, in the given order."""
    files.prepare(CUBE)
    written = [f"{CUBE}/{key}" for key in keys]
    for key in written:
        files.write(key, contents[key.removeprefix(f"{CUBE}/")])
    files.sync(written)


def skeleton_problems(info: RunInfo) -> list[str]:
    """Return a line for each metadata or coordinate file of the result cube that is missing or has changed.

    If none has, return a line for each array whose metadata differ from their copy in the group's file.
    """
    return _compare(info, info.skeleton)[1]


def _compare(info: RunInfo, keys: Iterable[str]) -> tuple[dict[str, bytes], list[str]]:
    """Compare files of the set-up with their digests; return the contents of small ones, and the problems of all."""
    chosen = {key: info.skeleton[key] for key in keys}
    folders = {key.partition("/")[0] for key in chosen if "/" in key}
    info.files.refuse_links(CUBE, *(f"{CUBE}/{folder}" for folder in folders))
    contents, problems = {}, []
    for key, content, problem in compared(info.files.below(CUBE), chosen):
        if problem:
            problems.append(problem)
        elif len(content) <= MOST_KEPT:
            contents[key] = content
    return contents, problems or disagreements(contents)


def check_skeleton(info: RunInfo) -> dict[str, bytes]:
    """Compare the cube's metadata and coordinates with their digests in ``run.json``; return the contents of the small
    files.

    In an object store, where each file is a request, the arrays' own metadata are not read if the group's file repeats
    them all: readers then use that file, whose digest is compared, and no other. Raise `DamagedError`, which names the
    files and the remedy, if a file is missing or has changed.
    """
    keys = list(info.skeleton)
    first = [key for key in keys if key == METADATA or not key.endswith(METADATA)]
    rest = [key for key in keys if key not in first]
    if info.files.local is not None:
        first, rest = keys, []
    contents, problems = _compare(info, first)
    copies = consolidated_metadata(contents.get(METADATA, b""))
    if any(key.rpartition("/")[0] not in copies for key in rest):
        own, others = _compare(info, rest)
        contents, problems = {**contents, **own}, problems + others
    if problems:
        more = f" (and {len(problems) - 3} more)" if len(problems) > 3 else ""
        raise DamagedError(
            f"{info.files.below(CUBE).name}: {'; '.join(problems[:3])}{more}. These files follow from the "
            f"specification: rebuild them with: magpend verify --repair {info.name}"
        )
    return contents
