"""What a run finds in its directory before it goes on: compared with its records, and set right."""

from __future__ import annotations

import time
from collections.abc import Callable

from pipeline.layout.plan import Plan
from pipeline.runs.progress import duration
from pipeline.store.checking import damaged_records
from pipeline.store.commits import scan, sweep
from pipeline.store.packing import withdraw
from pipeline.store.records import Records
from pipeline.store.runfile import RunInfo
from pipeline.store.view import VERIFY, checks_chunks

Echo = Callable[[str], None]

_LONG_SECONDS = 5.0
_NAMED = 10


def sound_commits(info: RunInfo, plan: Plan, echo: Echo, *, alone: bool = True) -> Records:
    """Return the records whose chunks are what was written, byte for byte; the others are withdrawn.

    Equal sizes and times prove nothing, so every committed file is read, unless the environment has
    ``MAGPEND_VERIFY=0``: then sizes alone are compared. What no record vouches for is removed. For the holder
    of the lock.

    Parameters
    ----------
    info, plan
        The run.
    echo
        Prints a line; names what is computed again, and why.
    alone
        Whether no other process can be writing here; else what no record vouches for stays, since another
        may be about to commit it.
    """
    started = time.perf_counter()
    contents = checks_chunks()
    records, damaged = damaged_records(info, plan, contents=contents)
    seconds = time.perf_counter() - started
    if contents and seconds > _LONG_SECONDS:
        echo(
            f"{len(records)} committed tasks compared with their records in {duration(seconds)} "
            f"({VERIFY}=0 leaves that out)"
        )
    for problem in list(damaged.values())[:_NAMED]:
        echo(f"{problem}: computed again")
    if len(damaged) > _NAMED:
        echo(f"and {len(damaged) - _NAMED} more")
    if damaged:
        withdraw(info, damaged)
        records, _ = scan(info, plan)
    if alone:
        sweep(info, plan, records, echo)
    return records
