"""Compare the stored files of a run with their checksums, and repair the run, for ``magpend verify``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from pipeline.store.checking import ODD, Verification, verify
from pipeline.store.commits import withdraw
from pipeline.store.files import ASIDE, DERIVED
from pipeline.store.products import remove_product
from pipeline.store.record_copy import remove_copy
from pipeline.store.runfile import read_run
from pipeline.store.setup import rebuild_skeleton


def verify_run(directory: str | Path, *, repair: bool = False) -> Verification:
    """Compare every stored file of a run with its checksum; with `repair`, rebuild or discard damaged files.

    Parameters
    ----------
    directory
        Run directory.
    repair
        Whether to repair: rebuild damaged metadata and coordinates, withdraw the records of damaged tasks,
        which then are pending, and remove damaged products.

    Raises
    ------
    RefusedError
        If there is no run in `directory`.
    DamagedError
        If ``run.json`` has changed since it was written.
    UnreadableError
        If a file exists and cannot be read; nothing is changed.
    LockedError
        With `repair`, if something is damaged and a run is writing to the directory.
    """
    info = read_run(directory)
    found = verify(info)
    if found.sound or not repair:  # an intact run may lie where nobody may write
        return found
    with info.files.lock():
        found = verify(info)
        for key in found.odd:
            info.files.move_aside(key)
        rest = rebuild_skeleton(info)
        withdraw(info, found.damaged)
        if found.copies:
            remove_copy(info)
        for name in found.derived:
            remove_product(info.files.below(DERIVED).below(name))
    rebuilt = [problem for problem in found.skeleton if problem not in rest]
    return replace(found, skeleton=rest, rebuilt=rebuilt)


def describe(found: Verification, directory: str | Path, *, repaired: bool) -> list[str]:
    """Return text lines on the result of a verification."""
    lines = [f"{directory}: {found.n_committed} of {found.n_tasks} tasks committed and intact"]
    odd = [f"{key}: {ODD}" for key in found.odd]
    lines += [
        f"  damaged: {text}"
        for text in (*odd, *found.damaged.values(), *found.skeleton, *found.derived.values(), *found.copies)
    ]
    lines += [f"  rebuilt: {text}" for text in found.rebuilt]
    if found.leftovers:
        lines.append(f"  {len(found.leftovers)} uncommitted files, which nothing reads; the next run removes them")
    if found.skeleton and repaired:
        lines.append(
            "Metadata or coordinates differ from those that this version writes: another version of "
            "magpend or zarr made them (run.json names it). Repair the run with that version, or run "
            "the specification again."
        )
    elif found.skeleton:
        lines.append("Metadata and coordinates follow from the specification: rebuild them with --repair.")
    if found.damaged and repaired:
        lines.append(f"{len(found.damaged)} records withdrawn: run the specification again to compute these tasks.")
    if found.odd:
        lines.append(f"{len(found.odd)} moved into {directory}/{ASIDE}." if repaired else "--repair moves these aside.")
    if found.derived and repaired:
        lines.append(f"{len(found.derived)} products removed: they are computed again on demand.")
    elif found.derived:
        lines.append("Damaged products are computed again on demand; --repair removes them.")
    if found.copies:
        lines.append(
            "The copy of commit records is removed." if repaired else "--repair removes the copy of commit records."
        )
    if found.damaged and not repaired:
        lines.append("Withdraw them with --repair, then run the specification again to compute these tasks.")
    return lines
