"""Hold leases in object stores, which have no file locks, and name the process that holds a lock.

An object store has no lock that ends with its process. A lease is the object ``lock``; it names its holder.
The holder puts it if it is absent, and again every `RENEW_S`. Another process takes the lease over if it has
not been renewed for `LEASE_S`, or if its holder was a process of this machine that has ended. Like any lock,
a lease is a courtesy: the commit protocol does not rely on it.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import threading
import uuid
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from typing import Any, Protocol

from pipeline.store.errors import LockedError, StoreError
from pipeline.store.files import LOCK

RENEW_S, LEASE_S = 30.0, 150.0
"""Seconds between renewals of a lease, and seconds without renewal after which it lapses."""


def holder() -> dict[str, Any]:
    """Return a note that names this process as the holder of a lock: host, process id, and the time (UTC)."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return {"host": platform.node(), "pid": os.getpid(), "since": now}


def in_words(content: bytes) -> str:
    """Return a phrase that names the process holding a lock; empty if the note about it is damaged."""
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
    """Return whether a file's content is a note that names the holder of a lock."""
    return _holder_in(content) is not None


def _has_ended(content: bytes) -> bool:
    """Return whether the holder of a lock was a process of this machine that has ended."""
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


class Leased(Protocol):
    """Interface to the files of an object store, as far as a lease needs it; see
    `pipeline.store.objects.ObjectFiles`.
    """

    @property
    def name(self) -> str:
        """URL of the run in the object store."""

    @property
    def store(self) -> Any:
        """Client of the package obstore for the object store."""

    def put_lines(self) -> None:
        """Write the lines that were appended to objects but kept in memory so far."""

    def is_there(self, key: str) -> bool:
        """Return whether there is an object."""

    def read(self, key: str) -> bytes:
        """Return an object's content."""

    def write(self, key: str, content: bytes) -> None:
        """Write an object."""

    def remove(self, keys: Iterable[str]) -> None:
        """Remove objects."""


@contextlib.contextmanager
def lease(files: Leased) -> Iterator[None]:
    """Hold the lease of a run in an object store inside this context: a lock that expires unless it is renewed.

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
        # a failure does no harm here: the lease lapses
        with contextlib.suppress(FileNotFoundError, StoreError):
            files.put_lines()
            if files.read(LOCK) == content:
                files.remove([LOCK])


class _TakenError(Exception):
    """An error for a lease that another process has replaced in the meantime."""


def _take(files: Leased, content: bytes) -> str:
    """Create the lease object, or take over an expired one; return its entity tag."""
    import obstore

    try:
        return str(obstore.put(files.store, LOCK, content, mode="create", use_multipart=False)["e_tag"])
    except obstore.exceptions.AlreadyExistsError:
        pass
    except (obstore.exceptions.BaseError, OSError):
        # the lease may have been put although the answer was lost; any other problem shows below
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


def _found(files: Leased) -> tuple[bytes, str, float] | None:
    """Return content, entity tag and age in seconds of the present lease object; None if there is none."""
    import obstore

    try:
        found = obstore.get(files.store, LOCK)
    except FileNotFoundError:
        files.is_there(LOCK)  # raises if the bucket itself is missing
        return None
    except (obstore.exceptions.BaseError, OSError):
        files.read(LOCK)
        return None
    age = datetime.now(UTC) - found.meta["last_modified"]
    return bytes(found.bytes()), str(found.meta["e_tag"]), age.total_seconds()


def _replace(files: Leased, content: bytes, tag: str) -> str:
    import obstore

    try:
        put = obstore.put(files.store, LOCK, content, mode={"e_tag": tag}, use_multipart=False)
    except obstore.exceptions.PreconditionError:
        raise _TakenError from None
    except (obstore.exceptions.BaseError, OSError):
        return tag  # not renewed this time
    return str(put["e_tag"])
