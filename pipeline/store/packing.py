"""Merge the commit records of each block of tasks into one file (a pack), and remove records from such files.

Only the holder of the lock may call these functions. A pack is durable before the single records that it
replaces are removed: a crash at any moment leaves every record either there or in the pack.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping

from pipeline.layout.plan import Plan
from pipeline.store.commits import scan
from pipeline.store.files import COMMITS
from pipeline.store.record_copy import remove_copy
from pipeline.store.records import BLOCK, Commit, Records, block_of_pack, marker_key, pack_key, pack_text, salvage
from pipeline.store.runfile import RunInfo


class Packer:
    """Merger of commit records: it counts committed tasks, and merges the records of each complete block of tasks into
    one file (a pack).

    Parameters
    ----------
    info, plan
        The run and its plan.
    commits
        Records that are committed already.
    """

    def __init__(self, info: RunInfo, plan: Plan, commits: Records) -> None:
        self._info = info
        self._plan = plan
        self._n_whole = plan.n_tasks // BLOCK
        self._counts = Counter(i // BLOCK for i in commits)
        packed = {block for block, pack in commits.packs.items() if not pack.without}
        for block in sorted(set(self._counts) - packed):
            self._pack_if_whole(block)

    def add(self, index: int) -> None:
        """Count a newly committed task; if its block of tasks is complete, merge the block's commit records into one
        file.
        """
        self._counts[index // BLOCK] += 1
        self._pack_if_whole(index // BLOCK)

    def _pack_if_whole(self, block: int) -> None:
        if block < self._n_whole and self._counts[block] >= BLOCK:
            pack_block(self._info, self._plan, block)


def pack_block(info: RunInfo, plan: Plan, block: int) -> bool:
    """Merge the commit records of a block of tasks into one file if all of them are valid; return whether they are."""
    tasks = range(block * BLOCK, (block + 1) * BLOCK)
    commits, _ = scan(info, plan, blocks={block})
    if not all(index in commits for index in tasks):
        return False
    pack = commits.packs.get(block)
    if pack is None or pack.without:
        info.files.write(pack_key(block), pack_text(commits, info.digest, block))
    info.files.remove([marker_key(index) for index in tasks])
    return True


def withdraw(info: RunInfo, names: Iterable[str]) -> None:
    """Remove commit records, so that the next run computes their tasks again.

    Parameters
    ----------
    info
        The run.
    names
        File names of the records, as if each had its own file; or the name of a damaged pack, whose
        whole records stay.
    """
    info.files.refuse_links(COMMITS)
    remove_copy(info)
    folder = info.files.below(COMMITS)
    blocks: dict[int, set[int]] = {}
    for name in names:
        block = block_of_pack(name)
        stem = name.removesuffix(".json")
        if block is not None:
            blocks.setdefault(block, set())
        elif stem.isdecimal() and marker_key(int(stem)) == f"{COMMITS}/{name}":
            blocks.setdefault(int(stem) // BLOCK, set()).add(int(stem))
        folder.remove([name] if block is None else [])
    for block, tasks in blocks.items():
        _rewrite(info, block, tasks)


def _rewrite(info: RunInfo, block: int, tasks: set[int]) -> None:
    """Rewrite a pack (a file of many commit records) without the records of some tasks and without damaged ones."""
    try:
        content = info.files.read(pack_key(block))
    except FileNotFoundError:  # none, or a link, which is not read
        content = b""
    kept: Mapping[int, Commit] = {
        index: commit for index, commit in salvage(content, info.digest, block).items() if index not in tasks
    }
    if kept:
        info.files.write(pack_key(block), pack_text(kept, info.digest, block))
    else:
        info.files.remove([pack_key(block)])
