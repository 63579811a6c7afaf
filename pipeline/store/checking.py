"""Compare the stored files of a run with their recorded sizes or sha256 digests; discard damaged tasks."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from pipeline.products.reporting import report
from pipeline.store.commits import absent_objects, leftover_keys, scan, sweep, withdraw
from pipeline.store.errors import DamagedError, IncompleteError
from pipeline.store.files import COMMITS, CUBE, DERIVED, VERIFY, Files, checks_chunks, problems_of
from pipeline.store.products import products_in, read_product_attrs
from pipeline.store.record_copy import copy_problem, write_copy
from pipeline.store.records import Records, marker_key
from pipeline.store.runfile import RunInfo
from pipeline.store.skeleton import skeleton_problems

Echo = Callable[[str], None]

ODD = "is a folder where a file should be, or a file where a folder should be"

_TASKS_PER_REPORT = 50
_LONG_SECONDS = 5.0
_NAMED = 10


@dataclass(frozen=True)
class Verification:
    """Result of `verify`: the number of intact tasks, and lists of damaged and leftover files."""

    # tasks of the run, and those that are committed and intact
    n_tasks: int
    n_committed: int
    damaged: dict[str, str]  # problem by the file name of the commit record; see `commits.withdraw`
    skeleton: list[str]  # problems of metadata and coordinates
    leftovers: list[str]  # files without a valid commit record. They are harmless; the next run removes them.
    derived: dict[str, str] = field(default_factory=dict)  # problem by product name: products whose content has changed
    rebuilt: list[str] = field(default_factory=list)  # problems of the skeleton that have been repaired
    odd: list[str] = field(default_factory=list)  # folders at the places of files, and files at the places of folders
    copies: list[str] = field(default_factory=list)  # problem of the copy of commit records, if it differs from them

    @property
    def sound(self) -> bool:
        """Whether nothing is damaged: neither committed tasks nor metadata, coordinates and stored analysis results."""
        return not (self.damaged or self.skeleton or self.derived or self.odd or self.copies)


def verify(info: RunInfo) -> Verification:
    """Compare every stored file of a run with its recorded sha256; return what is damaged or left over."""
    info.files.refuse_links(CUBE)
    records, damaged = damaged_records(info, contents=True)
    n_whole = sum(name_of(index) not in damaged for index in records)
    leftovers = [key.removeprefix(f"{CUBE}/") for key in leftover_keys(info, records)]
    named = {f"{COMMITS}/{name}" for name in damaged}
    return Verification(
        n_tasks=info.plan.n_tasks,
        n_committed=n_whole,
        damaged=dict(sorted(damaged.items())),
        skeleton=skeleton_problems(info),
        leftovers=sorted(key for key in leftovers if key not in named),
        derived=damaged_products(info),
        odd=odd_keys(info.files, info.skeleton),
        copies=[problem] if (problem := copy_problem(info, records)) else [],
    )


def odd_keys(files: Files, skeleton: Iterable[str]) -> list[str]:
    """Return the keys of folders found where a run should have files, and of files where it should have folders.

    `skeleton` has the keys of the set-up's files, below the cube.
    """
    folders = dict.fromkeys(key.rpartition("/")[0] for key in skeleton)
    return files.odd([CUBE, *(f"{CUBE}/{folder}" for folder in folders if folder), COMMITS])


def name_of(index: int) -> str:
    """Return the file name of a single task's commit record, even if the record lies in a pack."""
    return marker_key(index).removeprefix(f"{COMMITS}/")


def damaged_records(info: RunInfo, *, contents: bool) -> tuple[Records, dict[str, str]]:
    """Return the valid commit records of a run's tasks, and the problems of the damaged records by file name.

    A record is damaged, too, if a file that it lists is missing or has changed: in its content, or, without `contents`,
    in its size.
    """
    records, rejected = scan(info)
    damaged = {name: f"{COMMITS}/{name}: {problem}" for name, problem in rejected.items()}
    found = _changed_objects(info, records) if contents else absent_objects(info, records)
    return records, damaged | {name_of(index): problem for index, problem in found.items()}


def whole_records(info: RunInfo) -> frozenset[int]:
    """Return the tasks with a valid commit record whose files all exist with their sizes."""
    records, damaged = damaged_records(info, contents=False)
    return frozenset(index for index in records if name_of(index) not in damaged)


def sound_commits(info: RunInfo, echo: Echo, *, alone: bool = True) -> Records:
    """Return the commit records of all undamaged tasks; damaged tasks are discarded, to be computed again.

    Equal sizes and times prove nothing, so every committed file is read. With ``MAGPEND_VERIFY=0`` in the
    environment only sizes are compared. Files without a record are removed. Only the holder of the lock may
    call this.

    Parameters
    ----------
    info
        The run.
    echo
        Function that prints a line about each task that is computed again, with the reason.
    alone
        Whether no other process can be writing here. Otherwise files without a record stay, since another
        process may be about to commit them.
    """
    started = time.perf_counter()
    contents = checks_chunks()
    records, damaged = damaged_records(info, contents=contents)
    seconds = time.perf_counter() - started
    if contents and seconds > _LONG_SECONDS:
        echo(f"{len(records)} committed tasks compared with their records in {seconds:.0f} s ({VERIFY}=0 skips this)")
    for problem in list(damaged.values())[:_NAMED]:
        echo(f"{problem}: computed again")
    if len(damaged) > _NAMED:
        echo(f"and {len(damaged) - _NAMED} more")
    if damaged:
        withdraw(info, damaged)
        records, _ = scan(info)
    if alone:
        sweep(info, records, echo)
    return records


def require_all(info: RunInfo, echo: Echo) -> None:
    """Raise IncompleteError unless every task is committed; remove the files that stopped tasks left."""
    commits, problems = damaged_records(info, contents=False)
    n_tasks = info.plan.n_tasks
    absent = [i for i in range(n_tasks) if i not in commits or name_of(i) in problems]
    if absent:
        why = f" {next(iter(problems.values()))}." if problems else ""
        raise IncompleteError(
            f"{info.name}: {len(absent)} of {n_tasks} tasks were computed but are not committed "
            f"here (the first is {absent[0]}).{why} Every worker must see this folder under this path, "
            "and have space to write. Then give the same command again; it computes only these tasks."
        )
    sweep(info, commits, echo)
    write_copy(info, commits)


def _changed_objects(info: RunInfo, records: Records) -> dict[int, str]:
    cube, found = info.files.below(CUBE), {}
    for n, index in enumerate(records):
        if n % _TASKS_PER_REPORT == 0:
            report("comparing what is committed with its records", n, len(records))
        try:
            problems = problems_of(cube, records[index].objects)
        except DamagedError as error:  # a line of a pack is no record
            problems = [str(error)]
        if problems:
            found[index] = "; ".join(problems)
    return found


def damaged_products(info: RunInfo) -> dict[str, str]:
    """Return the problems of damaged analysis results (products) in the folder ``derived``, by name."""
    found: dict[str, str] = {}
    for files in products_in(info.files.below(DERIVED)):
        try:
            read_product_attrs(files)
        except FileNotFoundError:
            continue
        except DamagedError as error:
            found[files.name.rpartition("/")[2]] = str(error).removeprefix(f"{info.name}/")
    return found
