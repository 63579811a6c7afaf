"""Open a run's files by path or URL, and read and write those in an object store, such as ``s3://bucket/prefix``.

Objects are put whole, and commit records only once. Credentials come from the environment alone
(``AWS_ACCESS_KEY_ID`` and the other names that S3 clients read). They are never kept, written or printed.

An object store has no lock that ends with its process. A lease is the object ``lock``; it names its holder.
The holder puts it if it is absent, and again every `RENEW_S`. Another process takes the lease over if it has
not been renewed for `LEASE_S`, or if its holder was a process of this machine that has ended. Like any lock,
a lease is a courtesy: the commit protocol does not rely on it.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from datetime import UTC, datetime, timedelta
from functools import cache
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import urlsplit

from pipeline.specification.problems import INSTALL
from pipeline.store.errors import DamagedError, LockedError, RefusedError, StoreError, UnreadableError
from pipeline.store.files import LOCK, Files, is_url, local_path
from pipeline.store.local import LocalFiles, has_ended, holder, in_words

if TYPE_CHECKING:
    from zarr.abc.store import Store
    from zarr.core.buffer import Buffer

T = TypeVar("T")

CREDENTIALS = (
    "AWS_ACCESS_KEY_ID",
    "AWS_SKIP_SIGNATURE",
    "AWS_WEB_IDENTITY_TOKEN_FILE",
    "AWS_METADATA_ENDPOINT",
    "AWS_CONTAINER_CREDENTIALS_RELATIVE_URI",
    "AWS_CONTAINER_CREDENTIALS_FULL_URI",
)
"""Environment variables, any one of them enough to tell who may use the store."""

REQUESTS_AT_ONCE = 16
"""Requests that are under way at the same time."""

CONNECT_S, REQUEST_S = 5.0, 60.0
"""Longest time to reach a store, and longest time of a whole request, in seconds."""

RETRIES, FIRST_WAIT_S, LONGEST_WAIT_S = 6, 0.2, 5.0
"""Number of times a request is repeated, and the waits in between [s]: about ten seconds in total."""

_URL = re.compile(r"s3://([a-z0-9][a-z0-9.-]{1,61}[a-z0-9])((?:/[^/?#@\s]+)*)/?")
_AGAIN = "committed results stay; give the same command again to continue."


def parse_url(text: str) -> ObjectFiles:
    """Parse a URL such as ``s3://bucket/prefix`` and return the files there.

    Raise `RefusedError` if it is no such URL, or if the package obstore or the credentials are missing.
    """
    if "@" in text or "?" in text:  # the message does not repeat the text, which may hold a password
        raise RefusedError("The URL of a run has no user, password or query: credentials are environment.")
    match = _URL.fullmatch(text)
    if match is None or {".", ".."} & set(text.split("/")):
        raise RefusedError(f"{text}: must be s3://BUCKET/PREFIX, such as s3://measurements/runs/first.")
    try:
        import obstore  # noqa: F401
    except ImportError:
        raise RefusedError(f"{text}: object stores need the package obstore; {INSTALL.format('s3')}") from None
    if not any(os.environ.get(name) for name in CREDENTIALS):
        raise RefusedError(f"{text}: there are no credentials; {_CREDENTIALS_HELP}")
    return ObjectFiles(match[1], match[2].strip("/"))


_CREDENTIALS_HELP = (
    "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY in the environment of magpend and of its workers "
    "(AWS_SKIP_SIGNATURE=true for a bucket that is open to all)."
)


def open_files(place: str | Path | Files) -> Files:
    """Return the files of a run, given by a folder or a URL such as ``s3://bucket/prefix``; `Files` are returned
    unchanged.

    Raise `RefusedError` if it is another URL, or the object store cannot be used.
    """
    if not isinstance(place, (str, Path)):
        return place
    if is_url(place):
        return parse_url(str(place))
    return LocalFiles(local_path(place))


class ObjectFiles:
    """Files of a run in a bucket of an object store, by key; see `pipeline.store.files.Files`.

    The prefix neither begins nor ends with a slash and may be empty.
    """

    local = None

    def __init__(self, bucket: str, prefix: str) -> None:
        self.bucket, self.prefix = bucket, prefix
        self.metadata: dict[str, Buffer] = {}
        self._store: Any = None
        self._below: dict[str, ObjectFiles] = {}
        self._lines: dict[str, list[str]] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        # only the place is sent to another process, which has its own credentials
        return ObjectFiles, (self.bucket, self.prefix)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ObjectFiles) and self.name == other.name

    def __hash__(self) -> int:
        return hash(self.name)

    def __repr__(self) -> str:
        return f"ObjectFiles({self.name!r})"

    @property
    def name(self) -> str:
        """URL of the prefix."""
        return f"s3://{self.bucket}/{self.prefix}".rstrip("/")

    @property
    def place(self) -> str:
        """URL of the prefix, by which another process opens the files."""
        return self.name

    @property
    def store(self) -> Any:
        """Client of the package obstore for the bucket and the prefix."""
        if self._store is None:
            self._store = _client(self.bucket, self.prefix)
        return self._store

    def below(self, prefix: str) -> ObjectFiles:
        """Return the files below a prefix; equal prefixes return one object, which keeps its connections."""
        if prefix not in self._below:
            self._below[prefix] = ObjectFiles(self.bucket, f"{self.prefix}/{prefix}".lstrip("/"))
        return self._below[prefix]

    def path(self, key: str) -> str:
        """Return the URL of an object."""
        return f"{self.name}/{key}".rstrip("/")

    def names(self) -> list[str]:
        """Return the first parts of all keys (the top-level names), sorted."""
        import obstore

        found = self._ask("", lambda: obstore.list_with_delimiter(self.store))
        names = sorted([*found["common_prefixes"], *(entry["path"] for entry in found["objects"])])
        if not names:
            raise FileNotFoundError(f"{self.name}: nothing is there")
        return names

    def is_there(self, key: str) -> bool:
        """Return whether an object exists."""
        import obstore

        try:
            # GET, since the answer to HEAD does not tell a missing object from a missing bucket
            self._ask(key, lambda: obstore.get(self.store, key))
        except FileNotFoundError:
            return False
        return True

    def read(self, key: str) -> bytes:
        """Return the content of an object."""
        import obstore

        return self._ask(key, lambda: bytes(obstore.get(self.store, key).bytes()))

    def read_each(self, keys: Iterable[str]) -> Iterator[tuple[str, bytes | FileNotFoundError]]:
        """Read several objects at once; yield each key with the content, or with a `FileNotFoundError`."""

        def read(key: str) -> bytes | FileNotFoundError:
            try:
                return self.read(key)
            except FileNotFoundError as error:
                return error

        rest = iter(keys)
        with ThreadPoolExecutor(REQUESTS_AT_ONCE) as pool:
            # memory holds no more contents than are read at once
            while some := list(islice(rest, REQUESTS_AT_ONCE)):
                yield from zip(some, pool.map(read, some), strict=True)

    def write(self, key: str, content: bytes) -> None:
        """Write an object; it replaces one with the same key."""
        import obstore

        self._ask(key, lambda: obstore.put(self.store, key, content, use_multipart=False), writing=True)

    def write_once(self, key: str, content: bytes) -> None:
        """Write an object unless it exists; raise `DamagedError` if it then has another content."""
        import obstore

        for attempt in range(RETRIES):
            try:
                obstore.put(self.store, key, content, mode="create", use_multipart=False)
                return
            except obstore.exceptions.AlreadyExistsError:
                pass  # also raised when two puts collide, and then none may have succeeded
            except (obstore.exceptions.BaseError, OSError) as error:
                # if the answer was lost, the put may have succeeded
                explained = explain(self.path(key), error, writing=True)
                if not isinstance(explained, UnreadableError) or attempt == RETRIES - 1:
                    raise explained from None
            if self._holds(key, content):
                return
            time.sleep(min(FIRST_WAIT_S * 2**attempt, LONGEST_WAIT_S))
        raise UnreadableError(f"{self.path(key)}: cannot be written while others write it; {_AGAIN}")

    def _holds(self, key: str, content: bytes) -> bool:
        try:
            found = self.read(key)
        except FileNotFoundError:
            return False
        if found != content:
            raise DamagedError(
                f"{self.path(key)}: is there with another content, which nobody but the writer of its run "
                "puts there; give the same command again."
            )
        return True

    def append(self, key: str, line: str) -> None:
        """Keep a line in memory until the lock is released, since objects cannot grow."""
        self._lines.setdefault(key, []).append(line)

    def put_lines(self) -> None:
        """Write the lines that `append` has kept in memory to the ends of their objects."""
        for key, lines in self._lines.items():
            before = b"".join(c for _, c in self.read_each([key]) if isinstance(c, bytes))
            self.write(key, before + "".join(f"{line}\n" for line in lines).encode())
        self._lines = {}

    def sizes(self) -> dict[str, int]:
        """Return the size of every object by key."""
        import obstore

        found = self._ask("", lambda: obstore.list(self.store, chunk_size=1000).collect())
        return {entry["path"]: entry["size"] for entry in found}

    def everything(self) -> list[str]:
        """Return the keys of all objects, sorted."""
        return sorted(self.sizes())

    def remove(self, keys: Iterable[str]) -> None:
        """Remove objects."""
        import obstore

        if gone := list(keys):
            self._ask("", lambda: obstore.delete(self.store, gone), writing=True)

    def sync(self, keys: Iterable[str]) -> None:
        """Make files durable: there is nothing to do, since an object is durable once the store has answered."""

    def prepare(self, prefix: str) -> None:
        """Create a folder: there is nothing to do, since an object store has no folders."""

    def odd(self, folders: Iterable[str]) -> list[str]:
        """Return the keys of folders where files should be: an object store has no folders."""
        return []

    def move_aside(self, key: str) -> str:
        """Move a file or folder out of the way: return the key unchanged, since an object store has no folders."""
        return key

    def refuse_links(self, *prefixes: str) -> None:
        """Refuse symbolic links: there is nothing to do, since an object store has none."""

    def zarr(self, *, read_only: bool) -> Store:
        """Return the objects below the prefix as a zarr store."""
        return _run_store(self, read_only)

    def lock(self) -> AbstractContextManager[None]:
        """Return a context manager that holds a lease, the lock of an object store; see `lease`."""
        return lease(self)

    def _ask(self, key: str, request: Callable[[], T], *, writing: bool = False) -> T:
        import obstore

        try:
            return request()
        except (obstore.exceptions.BaseError, OSError) as error:
            raise explain(self.path(key), error, writing=writing) from None


def _client(bucket: str, prefix: str) -> Any:
    """Open a bucket with the endpoint, region and credentials of the environment."""
    from obstore.exceptions import BaseError
    from obstore.store import S3Store

    try:
        return S3Store(
            bucket,
            prefix=prefix or None,
            client_options={
                # plain http is allowed only if the environment asks for it
                "allow_http": _endpoint().startswith("http://"),
                "connect_timeout": timedelta(seconds=CONNECT_S),
                "timeout": timedelta(seconds=REQUEST_S),
            },
            retry_config={
                "max_retries": RETRIES,
                "backoff": {
                    "init_backoff": timedelta(seconds=FIRST_WAIT_S),
                    "max_backoff": timedelta(seconds=LONGEST_WAIT_S),
                },
            },
        )
    except (BaseError, ValueError) as error:
        raise explain(f"s3://{bucket}/{prefix}", error) from None


def _endpoint() -> str:
    names = ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT")
    return next((os.environ[name] for name in names if os.environ.get(name)), "")


def explain(place: str, error: Exception, *, writing: bool = False) -> Exception:
    """Translate an error of an object store into an exception with a one-line message, without request data.

    The text of an obstore error holds the whole answer, which may name an access key.
    """
    text = str(error)
    status = re.search(r"status code: (\d{3})", text)
    code = re.search(r"<Code>([A-Za-z0-9]{1,60})</Code>", text)
    said = " ".join(found[1] for found in (status, code) if found)
    if "NoSuchBucket" in text or (writing and isinstance(error, FileNotFoundError)):
        return RefusedError(f"{place}: there is no such bucket at {_where()}; make it, or correct the name.")
    if isinstance(error, FileNotFoundError):
        return FileNotFoundError(f"{place}: is not there")
    if "/latest/" in text or "security-credentials" in text or "AssumeRole" in text:
        return RefusedError(f"{place}: no credentials could be had; {_CREDENTIALS_HELP}")
    if (status and status[1] in ("401", "403")) or type(error).__name__ == "UnauthenticatedError":
        return RefusedError(
            f"{place}: {_where()} refuses access ({said}); check AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, "
            "AWS_REGION and what they may do with the bucket."
        )
    if "redirect" in text:
        return RefusedError(f"{place}: {_where()} has this bucket in another region; set AWS_REGION.")
    if status and status[1] == "501":
        return RefusedError(f"{place}: {_where()} cannot do what is needed here ({said}): put if absent.")
    verb = "written" if writing else "read"
    if said:
        return UnreadableError(f"{place}: cannot be {verb}: {_where()} answers {said}; {_AGAIN}")
    return UnreadableError(f"{place}: cannot be {verb}: {_where()} does not answer; {_AGAIN}")


def _where() -> str:
    """Return the host name and port of the object store, without other parts of its URL."""
    parts = urlsplit(_endpoint())
    try:
        return f"{parts.hostname}:{parts.port}" if parts.port else parts.hostname or "the object store"
    except ValueError:
        return "the object store"


# ---- leases ------------------------------------------------------------------------------------

RENEW_S, LEASE_S = 30.0, 150.0
"""Seconds between renewals of a lease, and seconds without renewal after which it lapses."""


@contextlib.contextmanager
def lease(files: ObjectFiles) -> Iterator[None]:
    """Hold the lease of a run in an object store inside this context: a lock that expires unless it is renewed."""
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


def _take(files: ObjectFiles, content: bytes) -> str:
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
    if has_ended(there) or age_s > LEASE_S:
        with contextlib.suppress(_TakenError):
            return _replace(files, content, tag)
    raise LockedError(
        f"{files.name}: another magpend run is writing here{in_words(there)}. Wait for it or stop it, then "
        f"run again; the lock of a process that was killed lapses {LEASE_S:g} s after it was last renewed."
    )


def _found(files: ObjectFiles) -> tuple[bytes, str, float] | None:
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


def _replace(files: ObjectFiles, content: bytes, tag: str) -> str:
    import obstore

    try:
        put = obstore.put(files.store, LOCK, content, mode={"e_tag": tag}, use_multipart=False)
    except obstore.exceptions.PreconditionError:
        raise _TakenError from None
    except (obstore.exceptions.BaseError, OSError):
        return tag  # not renewed this time
    return str(put["e_tag"])


def _run_store(files: ObjectFiles, read_only: bool) -> Store:
    store: Store = _class_of_stores()(files, read_only=read_only)
    return store


@cache
def _class_of_stores() -> type[Any]:
    """Define the zarr store of a run in an object store, at its first use: importing zarr takes long."""
    from zarr.storage import ObjectStore

    class RunStore(ObjectStore[Any]):
        """A zarr store in an object store: errors have magpend's messages, and writers read metadata only once."""

        def __init__(self, files: ObjectFiles, *, read_only: bool = False) -> None:
            super().__init__(files.store, read_only=read_only)
            self._files = files

        def __reduce__(self) -> tuple[Any, ...]:
            return _run_store, (self._files, self.read_only)

        def with_read_only(self, read_only: bool = False) -> RunStore:
            """Return the same store for zarr, with the given read-only setting."""
            return RunStore(self._files, read_only=read_only)

        async def get(self, key: str, prototype: Any, byte_range: Any = None) -> Any:
            """Return the content of a key for zarr; None if the object does not exist."""
            kept = self._files.metadata
            if key in kept and not self.read_only:
                return kept[key]
            try:
                found = await super().get(key, prototype, byte_range)
            except Exception as error:
                raise explain(self._files.path(key), error) from None
            if found is not None and key.endswith("zarr.json") and not self.read_only:
                kept[key] = found
            return found

        async def set(self, key: str, value: Any) -> None:
            """Write the content of a key for zarr."""
            try:
                await super().set(key, value)
            except Exception as error:
                raise explain(self._files.path(key), error, writing=True) from None

    return RunStore
