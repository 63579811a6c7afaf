"""What ``magpend verify`` does and says."""

from __future__ import annotations

from pathlib import Path

from pipeline.layout.plan import make_plan
from pipeline.spec.parsing import parse_spec
from pipeline.store import directory as store


def verify_run(directory: str | Path, *, repair: bool = False) -> store.Verification:
    """Compare every committed file with its marker.

    Parameters
    ----------
    directory
        Run directory.
    repair
        Withdraw the markers of damaged tasks: they are pending from then on.

    Raises
    ------
    store.RefusedError
        If there is no run in `directory`.
    store.LockedError
        With `repair`, if a run is writing there.
    """
    info = store.read_run(Path(directory))
    plan = make_plan(parse_spec(info.spec))
    if not repair:
        return store.verify(info, plan)
    with store.writer_lock(info.directory):
        found = store.verify(info, plan)
        store.withdraw(info, found.damaged)
    return found


def describe(found: store.Verification, directory: str | Path, *, repaired: bool) -> list[str]:
    """Return the lines to print."""
    lines = [f"{directory}: {found.n_committed} of {found.n_tasks} tasks committed and intact"]
    lines += [f"  damaged: {text}" for text in found.damaged.values()]
    lines += [f"  damaged: {text}" for text in found.skeleton]
    if found.leftovers:
        lines.append(f"  {len(found.leftovers)} uncommitted files, read by nobody; the next run removes them")
    if found.skeleton:
        lines.append("Metadata or coordinates are damaged: remove the directory and run again.")
    elif found.damaged and repaired:
        lines.append(
            f"{len(found.damaged)} markers withdrawn: run the specification again to compute these tasks."
        )
    elif found.damaged:
        lines.append("Withdraw them with --repair, then run the specification again to compute these tasks.")
    return lines
