"""Who writes to a run: the holder of a lock by host, process and time, and leases where there is no lock.

An object store has no lock that goes with its process. A lease is the object ``lock`` that names its holder,
put if absent and put again every `RENEW_S`; one that has not been renewed for `LEASE_S`, or whose process
on this machine has ended, is taken over. As any lock it is a courtesy: the commit protocol does not rest
on it.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import threading
import uuid
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from pipeline.store.errors import LockedError, StoreError
from pipeline.store.files import LOCK

if TYPE_CHECKING:
    from pipeline.store.objects import ObjectFiles

RENEW_S, LEASE_S = 30.0, 150.0
"""Seconds after which a lease is renewed, and after which one that is not has lapsed."""


def holder() -> dict[str, Any]:
    """Who asks for a lock: host, process, since when (UTC)."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return {"host": platform.node(), "pid": os.getpid(), "since": now}


def in_words(content: bytes) -> str:
    """Say who holds a lock, from what was written of it; empty if that is not whole."""
    found = _holder_in(content)
    return f" (process {found['pid']} on {found['host']} since {found['since']})" if found else ""


def _holder_in(content: bytes) -> dict[str, Any] | None:
    try:
        data = json.loads(content)
        data = {"host": str(data["host"]), "pid": int(data["pid"]), "since": str(data["since"])}
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
    return data if all(text.isprintable() for text in (data["host"], data["since"])) else None


def is_note(content: bytes) -> bool:
    """Whether a content says who holds a lock."""
    return _holder_in(content) is not None


def _has_ended(content: bytes) -> bool:
    """Whether a holder was a process of this machine that is no more."""
    found = _holder_in(content)
    if found is None or found["host"] != platform.node():
        return False
    try:
        os.kill(found["pid"], 0)
    except ProcessLookupError:
        return True
    except (OSError, OverflowError):
        return False
    return False


@contextlib.contextmanager
def lease(files: ObjectFiles) -> Iterator[None]:
    """Hold the lease of a run in an object store.

    Raises
    ------
    LockedError
        If another process holds it.
    """
    content = json.dumps({**holder(), "token": uuid.uuid4().hex}, sort_keys=True).encode()
    tag = [_take(files, content)]
    stop = threading.Event()

    def renew() -> None:
        while not stop.wait(RENEW_S):
            try:
                tag[0] = _replace(files, content, tag[0])
            except _TakenError:
                return

    thread = threading.Thread(target=renew, name="magpend lease", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        # what cannot be done now does no harm: the lease lapses
        with contextlib.suppress(FileNotFoundError, StoreError):
            files.put_lines()
            if files.read(LOCK) == content:
                files.remove([LOCK])


class _TakenError(Exception):
    """Somebody else has put a lease."""


def _take(files: ObjectFiles, content: bytes) -> str:
    """Put the lease if there is none that holds; returns its tag."""
    import obstore

    try:
        return str(obstore.put(files.store, LOCK, content, mode="create", use_multipart=False)["e_tag"])
    except obstore.exceptions.AlreadyExistsError:
        pass
    except (obstore.exceptions.BaseError, OSError):
        # the answer may have been lost, and the lease put; what else is wrong shows below
        pass
    found = _found(files)
    if found is None:
        files.write(LOCK, content)
        found = _found(files)
    if found is None or found[0] == content:
        return found[1] if found else ""
    there, tag, age_s = found
    if _has_ended(there) or age_s > LEASE_S:
        with contextlib.suppress(_TakenError):
            return _replace(files, content, tag)
    raise LockedError(
        f"{files.name}: another magpend run is writing here{in_words(there)}. Wait for it or stop it, then "
        f"run again; the lock of a process that was killed lapses {LEASE_S:g} s after it was last renewed."
    )


def _found(files: ObjectFiles) -> tuple[bytes, str, float] | None:
    """Content, tag and age in seconds of the lease that is there."""
    import obstore

    try:
        found = obstore.get(files.store, LOCK)
    except FileNotFoundError:
        files.is_there(LOCK)  # a missing bucket is another matter
        return None
    except (obstore.exceptions.BaseError, OSError):
        files.read(LOCK)
        return None
    age = datetime.now(UTC) - found.meta["last_modified"]
    return bytes(found.bytes()), str(found.meta["e_tag"]), age.total_seconds()


def _replace(files: ObjectFiles, content: bytes, tag: str) -> str:
    """Put the lease in the place of the one that has a tag."""
    import obstore

    try:
        put = obstore.put(files.store, LOCK, content, mode={"e_tag": tag}, use_multipart=False)
    except obstore.exceptions.PreconditionError:
        raise _TakenError from None
    except (obstore.exceptions.BaseError, OSError):
        return tag  # not renewed this time
    return str(put["e_tag"])
