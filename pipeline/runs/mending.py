"""Compare the files of a run with its commit records before the run continues, and discard damaged tasks."""

from __future__ import annotations

import time
from collections.abc import Callable

from pipeline.layout.plan import Plan
from pipeline.runs.progress import duration
from pipeline.store.checking import damaged_records
from pipeline.store.commits import scan, sweep, withdraw
from pipeline.store.records import Records
from pipeline.store.runfile import RunInfo
from pipeline.store.view import VERIFY, checks_chunks

Echo = Callable[[str], None]

_LONG_SECONDS = 5.0
_NAMED = 10


def sound_commits(info: RunInfo, plan: Plan, echo: Echo, *, alone: bool = True) -> Records:
    """Return the commit records of all undamaged tasks; damaged tasks are discarded, to be computed again.

    Equal sizes and times prove nothing, so every committed file is read. With ``MAGPEND_VERIFY=0`` in the
    environment only sizes are compared. Files without a record are removed. Only the holder of the lock may
    call this.

    Parameters
    ----------
    info, plan
        The run and its plan.
    echo
        Function that prints a line about each task that is computed again, with the reason.
    alone
        Whether no other process can be writing here. Otherwise files without a record stay, since another
        process may be about to commit them.
    """
    started = time.perf_counter()
    contents = checks_chunks()
    records, damaged = damaged_records(info, plan, contents=contents)
    seconds = time.perf_counter() - started
    if contents and seconds > _LONG_SECONDS:
        echo(
            f"{len(records)} committed tasks compared with their records in {duration(seconds)} ({VERIFY}=0 skips this)"
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
