"""Keep one file with a copy of all commit records that are in no pack, for readers over a network.

A complete run of fewer than a thousand tasks has one file for each commit record, and in an object store each is a
request. Its copy, ``records.jsonl``, is written when the run is complete and has the lines of these records,
unchanged. The copy proves nothing alone: a line counts only while the record's own file is there with the same size.
Commands that write, and `verify`, read the records themselves. `verify` reports a copy that differs from them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping

from pipeline.store.files import RECORD_COPY
from pipeline.store.records import Commit, Records, line_of, marker_key, read_record
from pipeline.store.runfile import RunInfo
from pipeline.store.stored_json import fits, seal


def copy_text(singles: Mapping[int, Commit], digest: str) -> bytes:
    """Return the content of the copy: unpacked commit records in order, then their number and a checksum."""
    body = b"".join(line_of(singles[index], digest) for index in sorted(singles))
    return body + seal(json.dumps({"digest": digest, "records": len(singles)}, sort_keys=True), body).encode()


def write_copy(info: RunInfo, commits: Records) -> None:
    """Write the copy for a complete run whose records are not all in packs; remove it for any other run.

    Only the holder of the lock may call this.
    """
    if len(commits) < info.plan.n_tasks or not commits.singles:
        remove_copy(info)
        return
    content = copy_text(commits.singles, info.digest)
    if _content(info) != content:
        info.files.write(RECORD_COPY, content)


def remove_copy(info: RunInfo) -> None:
    """Remove the copy, before a record is withdrawn or added."""
    if info.files.is_there(RECORD_COPY):
        info.files.remove([RECORD_COPY])


def copied_records(info: RunInfo, sizes: Mapping[str, int]) -> dict[int, Commit]:
    """Return by task the records in an undamaged copy whose own files have the sizes given by name."""
    content = _content(info)
    if content is None or not fits(content):
        return {}
    found = {}
    for line in content.splitlines(keepends=True)[:-1]:
        commit = read_record(line, info.digest)
        if isinstance(commit, Commit) and sizes.get(marker_key(commit.task).rpartition("/")[2]) == len(line):
            found[commit.task] = commit
    return found


def copy_problem(info: RunInfo, commits: Records) -> str | None:
    """Return a line of text if there is a copy that differs from the valid records that are in no pack."""
    content = _content(info)
    if content is None or content == copy_text(commits.singles, info.digest):
        return None
    return f"{RECORD_COPY}: differs from the commit records"


def _content(info: RunInfo) -> bytes | None:
    for _, content in info.files.read_each([RECORD_COPY]):
        return content if isinstance(content, bytes) else None
    return None
